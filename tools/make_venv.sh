#!/bin/sh
# Make the virtual environment $1, after checking what the installation needs from the machine:
# Python 3.11-3.13 with venv and headers, and a C++ compiler. Each lack is told in one sentence.
# With --check in place of the folder, only check.
set -eu
venv=$1

fail() {
    echo "evsplat set-up: $1" >&2
    exit 1
}

suits() {
    "$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' >/dev/null 2>&1
}

if [ -n "${PYTHON:-}" ]; then
    suits "$PYTHON" || fail "PYTHON=$PYTHON does not run or is not Python 3.11, 3.12 or 3.13."
    python=$PYTHON
else
    python=
    for candidate in python3 python3.13 python3.12 python3.11 python; do
        if suits "$candidate"; then
            python=$candidate
            break
        fi
    done
    [ -n "$python" ] || fail "no Python 3.11, 3.12 or 3.13 found; install one or name it with PYTHON=/path/to/python."
fi

"$python" -c 'import ensurepip, venv' >/dev/null 2>&1 ||
    fail "$python cannot make virtual environments; install its venv module (Debian, Ubuntu: apt install python3-venv)."
"$python" -c 'import os, sys, sysconfig; sys.exit(not os.path.exists(os.path.join(sysconfig.get_paths()["include"], "Python.h")))' ||
    fail "$python has no C headers (Python.h); install them (Debian, Ubuntu: apt install python3-dev)."
if [ -n "${CXX:-}" ]; then
    command -v "${CXX%% *}" >/dev/null || fail "the C++ compiler CXX=$CXX is not found."
else
    command -v c++ >/dev/null || command -v g++ >/dev/null || command -v clang++ >/dev/null ||
        fail "no C++ compiler found; install one (Debian, Ubuntu: apt install g++; macOS: xcode-select --install)."
fi

[ "$venv" != --check ] || exit 0
if [ -x "$venv/bin/python" ] && suits "$venv/bin/python"; then
    exit 0
fi
if [ -e "$venv" ] && [ ! -e "$venv/pyvenv.cfg" ]; then
    fail "$venv exists and is no virtual environment; name another place with VENV=..."
fi
"$python" -m venv --clear "$venv"
