#!/usr/bin/env bash
# Run one of this folder's scripts in an environment that holds a single tool and is removed afterwards:
#   tools/in_throwaway_venv.sh PACKAGE==VERSION SCRIPT [ARGUMENT ...]
set -euo pipefail
cd -P -- "$(dirname -- "${BASH_SOURCE[0]}")/.."
unset CDPATH PYTHONHOME PYTHONPATH
export PIP_DISABLE_PIP_VERSION_CHECK=1

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
if ! { "${PYTHON:-python3.11}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install "$1"; } >"$folder/log" 2>&1; then
    tail -n 3 "$folder/log" >&2
    echo "${2##*/}: cannot get $1: it needs Python 3.11 with venv, and the package index" >&2
    exit 1
fi
"$folder/venv/bin/python" "${@:2}"
