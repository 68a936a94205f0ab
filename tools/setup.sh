#!/usr/bin/env bash
# Make .venv what environment.lock says and install this project in it; `make` calls this first.
# Says nothing and takes no time when that is so already. PYTHON names the Python 3.11 to use.
set -euo pipefail
cd -P -- "$(dirname -- "${BASH_SOURCE[0]}")/.."
unset CDPATH PYTHONHOME PYTHONPATH PIP_PREFIX PIP_REQUIRE_HASHES PIP_REQUIRE_VIRTUALENV PIP_TARGET PIP_USER
export PIP_NO_INPUT=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PYTHONUTF8=1

python=${PYTHON:-python3.11}
log=setup.log

fail() {
    printf 'set-up: %s\n' "$1" >&2
    exit 1
}

# The content of the locks decides, not their time stamps; the folder too, because neither an
# environment nor an editable installation survives being moved or copied.
environment_key() { { pwd && cat environment.lock environment-cuda.lock; } | sha256sum; }
project_key() { sha256sum <pyproject.toml; }
recorded() { [ -x .venv/bin/python ] && [ "$(cat ".venv/$1" 2>/dev/null)" = "$2" ]; }
record() { printf '%s\n' "$2" >".venv/$1.new" && mv ".venv/$1.new" ".venv/$1"; }

up_to_date() { recorded environment.key "$(environment_key)" && recorded project.key "$(project_key)"; }

# The lock's entry for one package, with its hashes.
pinned() { sed -n "/^$1==/,/# via/p" environment.lock; }

# Name the cause of a failed installation in one line, if the log shows a known one.
explain() {
    if grep -q 'No space left on device' "$log" 2>/dev/null; then
        fail "the disk is full; the environment needs about 2 GB"
    elif grep -q 'DO NOT MATCH THE HASHES' "$log"; then
        fail "a downloaded package differs from the one environment.lock pins; not installed (details: $log)"
    elif grep -qE 'NewConnectionError|ConnectTimeout|ReadTimeout|ProxyError|ConnectionError|ConnectionReset|Max retries exceeded|SSLError' "$log"; then
        fail "no connection to the package index; set-up has to download packages once (details: $log)"
    fi
    tail -n 15 "$log" >&2
    fail "$1 (the whole output: $log)"
}

build_environment() {
    # The interpreter behind $python, which may itself belong to the .venv that goes now.
    local base
    base=$("$python" -c 'import sys; print(sys._base_executable)')
    rm -f .venv/environment.key .venv/project.key
    rm -rf .venv
    trap 'rm -rf .venv' EXIT # until it is complete; killed before that, it has no key and is rebuilt
    "$base" -m venv .venv >>"$log" 2>&1 || explain "$python could not create .venv"
    # --no-deps: the locks are complete, and torch's ordinary build must not ask here for what is in
    # the second one. A package that exists as source only is built by the pinned setuptools, which
    # therefore comes first; with build isolation pip would fetch build tools that nothing pins.
    local install=(.venv/bin/python -m pip install --require-hashes --no-deps --no-build-isolation
        --no-compile)
    local failed="pip could not install what the lock pins"
    "${install[@]}" -r <(pinned setuptools) >>"$log" 2>&1 || explain "$failed"
    # torch's CPU build, if pip sees one: left to itself, pip takes the ordinary build, because an
    # index tells it the hash of that beforehand.
    "${install[@]}" -r <(pinned torch | sed '1s/^torch==[^ ]*/&+cpu/') >>"$log" 2>&1 ||
        grep -q 'No matching distribution found for torch' "$log" || explain "$failed"
    "${install[@]}" -r environment.lock >>"$log" 2>&1 || explain "$failed"
    if { .venv/bin/python -m pip check 2>&1 || true; } | grep '^torch .* not installed' >>"$log"; then
        echo "torch is its ordinary build here: adding the CUDA packages it needs (several GB) ..." >&2
        "${install[@]}" -r environment-cuda.lock >>"$log" 2>&1 || explain "$failed"
    fi
    # Byte code for all at once, on every core, but not for the packages' own tests. The exit code
    # says nothing: some packages ship templates that are not Python.
    .venv/bin/python -m compileall -q -j 0 -x '/tests/' .venv/lib >>"$log" 2>&1 || true
    record environment.key "$(environment_key)"
    trap - EXIT
}

install_project() {
    .venv/bin/python -m pip install --no-deps --no-build-isolation --editable . >>"$log" 2>&1 ||
        explain "pip could not install this project"
    .venv/bin/python -m pip check >>"$log" 2>&1 ||
        explain "the environment lacks a package: pyproject.toml and environment.lock disagree (make lock)"
    record project.key "$(project_key)"
}

up_to_date && exit 0

"$python" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' >/dev/null 2>&1 ||
    fail "needs Python 3.11, and '$python' is not: install it (Debian, Ubuntu: apt install python3.11 python3.11-venv) or name one: make PYTHON=/path/to/python3.11"
"$python" -c 'import ensurepip, venv' >/dev/null 2>&1 ||
    fail "'$python' lacks the venv module: install it (Debian, Ubuntu: apt install python3.11-venv)"
case $PWD in *:*) fail "Python cannot make an environment in a folder with ':' in its path: $PWD" ;; esac
{ exec 9>.venv.lock; } 2>/dev/null || fail "cannot write in $PWD"

if ! flock --nonblock 9; then
    echo "Waiting for another set-up in this folder ..." >&2
    flock 9
    up_to_date && exit 0
fi
: >"$log"
if ! recorded environment.key "$(environment_key)"; then
    echo "Setting up .venv (about a minute, once) ..." >&2
    build_environment
fi
install_project
rm -f "$log"
