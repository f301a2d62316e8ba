# `make demo`, `make view` and `make test` set up a virtual environment on the first call and reuse
# it afterwards; each installs only what it needs on top of what is there. `make view` shows RUN, by
# default what `make demo` trained last.
# Options: PYTHON=python3.12 (which interpreter), VENV=.venv (where the environment lies),
# CONSTRAINTS=constraints-lowest.txt (which versions: the oldest ones that do).

VENV ?= .venv
CONSTRAINTS ?= constraints.txt
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
VIEW_STAMP := $(VENV)/.installed-view
DEV_STAMP := $(VENV)/.installed-dev
INSTALL := $(BIN)/python -m pip install --constraint $(CONSTRAINTS)
RUN ?= $(lastword $(sort $(wildcard runs/demo_*/*/*)))
SET_UP_INPUTS := pyproject.toml $(CONSTRAINTS) CMakeLists.txt \
	$(shell find native -type f 2>/dev/null | LC_ALL=C sort)

# Byte code is made of what is imported, as it is imported: of all of PyTorch, three quarters of an
# installation from the cache would go into it.
export PIP_COMPILE := no
# And it is kept, whatever the surroundings say: without it every process compiles PyTorch again, six
# seconds of each start.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo view test fuzz kill robustness lint types docs setup dependencies package clean

demo: $(STAMP)
	$(BIN)/evsplat demo $(DEMO_OPTIONS)

view: $(VIEW_STAMP)
	@test -n "$(RUN)" || { echo "No demo run yet: make demo first, or make view RUN=FOLDER" >&2; exit 2; }
	$(BIN)/evsplat view "$(RUN)" $(VIEW_OPTIONS)

test: $(DEV_STAMP)
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile $(TEST_OPTIONS)

# Damaged files of every kind, the same ones in every run; make fuzz FUZZ_OPTIONS="--seconds 3600 --seed 1" for others.
fuzz: $(DEV_STAMP)
	$(BIN)/python benchmarks/fuzz.py $(or $(FUZZ_OPTIONS),--seconds 120 --inputs 200000)

# Interruptions of every verb that writes; make kill KILL_OPTIONS="--seconds 3600" for longer.
kill: $(DEV_STAMP)
	$(BIN)/python benchmarks/kill.py $(or $(KILL_OPTIONS),--seconds 120)

robustness: fuzz kill

lint: $(DEV_STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(DEV_STAMP)
	$(BIN)/mypy

# Warnings, such as a link that leads nowhere, are errors.
docs: $(DEV_STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

setup: $(DEV_STAMP)

$(STAMP): $(SET_UP_INPUTS)
	@PYTHON="$(PYTHON)" sh tools/make_venv.sh "$(VENV)"
	@$(MAKE) --no-print-directory -j2 dependencies package || { cat "$(VENV)/package.log" >&2; exit 1; }
	@touch $@

# Packages are fetched and unpacked while the native module is compiled; pip alone does one after the
# other. What the compiler has to say comes last, where nothing else hides it.
dependencies:
	@$(BIN)/python -c 'import tomllib; \
	print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["dependencies"], sep="\n")' \
	> "$(VENV)/dependencies.txt"
	$(INSTALL) --requirement "$(VENV)/dependencies.txt"

package:
	@echo "Compiling the native module beside it, a minute or two on two cores"
	$(INSTALL) --quiet --no-deps --editable . >"$(VENV)/package.log" 2>&1

# The extras of what is installed, which pip then neither builds again nor looks for elsewhere.
$(VIEW_STAMP): $(STAMP)
	$(INSTALL) "evsplat[view]"
	@touch $@

$(DEV_STAMP): $(STAMP)
	$(INSTALL) "evsplat[dev]"
# Not in an extra, because it declares torchvision, which it never imports.
	$(INSTALL) --no-deps event-pienet
	@touch $@

clean:
	rm -rf $(VENV) build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis
