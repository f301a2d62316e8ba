# `make demo`, `make view` and `make test` set up a virtual environment on the first call and reuse
# it afterwards. `make view` shows RUN, by default what `make demo` trained last.
# Options: PYTHON=python3.12 (which interpreter), VENV=.venv (where the environment lies).

VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
RUN ?= $(lastword $(sort $(wildcard runs/demo_*/*/*)))
SET_UP_INPUTS := pyproject.toml constraints.txt CMakeLists.txt \
	$(shell find native -type f 2>/dev/null | LC_ALL=C sort)

.PHONY: demo view test fuzz kill robustness lint types docs setup clean

demo: $(STAMP)
	$(BIN)/evsplat demo $(DEMO_OPTIONS)

view: $(STAMP)
	@test -n "$(RUN)" || { echo "No demo run yet: make demo first, or make view RUN=FOLDER" >&2; exit 2; }
	$(BIN)/evsplat view "$(RUN)" $(VIEW_OPTIONS)

test: $(STAMP)
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile $(TEST_OPTIONS)

# Damaged files of every kind, the same ones in every run; make fuzz FUZZ_OPTIONS="--seconds 3600 --seed 1" for others.
fuzz: $(STAMP)
	$(BIN)/python benchmarks/fuzz.py $(or $(FUZZ_OPTIONS),--seconds 120 --inputs 200000)

# Interruptions of every verb that writes; make kill KILL_OPTIONS="--seconds 3600" for longer.
kill: $(STAMP)
	$(BIN)/python benchmarks/kill.py $(or $(KILL_OPTIONS),--seconds 120)

robustness: fuzz kill

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(STAMP)
	$(BIN)/mypy

# Warnings, such as a link that leads nowhere, are errors.
docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

setup: $(STAMP)

$(STAMP): $(SET_UP_INPUTS)
	@PYTHON="$(PYTHON)" sh tools/make_venv.sh "$(VENV)"
	$(BIN)/python -m pip install --constraint constraints.txt --editable ".[dev]"
# Not in an extra, because it declares torchvision, which it never imports.
	$(BIN)/python -m pip install --constraint constraints.txt --no-deps event-pienet
	@touch $@

clean:
	rm -rf $(VENV) build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis
