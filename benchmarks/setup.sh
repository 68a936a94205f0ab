#!/usr/bin/env bash
# Make benchmarks/.venv: the project's .venv and, on top of it, what benchmarks/environment.lock pins.
# So everything that is compared runs on the same torch, numpy and environments. `make bench` calls it.
set -euo pipefail
cd -P -- "$(dirname -- "${BASH_SOURCE[0]}")"
export PIP_NO_INPUT=1 PIP_DISABLE_PIP_VERSION_CHECK=1

key=$({ pwd && cat environment.lock ../.venv/environment.key; } | sha256sum)
[ "$(cat .venv/key 2>/dev/null)" = "$key" ] && exit 0

echo "Setting up benchmarks/.venv ..." >&2
rm -rf .venv
../.venv/bin/python -m venv --without-pip .venv
echo "import site, sys; site.addsitedir(sys.prefix + '/../../.venv/lib/python3.11/site-packages')" \
    >.venv/lib/python3.11/site-packages/project.pth
../.venv/bin/python -m pip --python .venv/bin/python install --quiet --require-hashes --no-deps \
    -r environment.lock
../.venv/bin/python -m pip --python .venv/bin/python check >/dev/null
printf '%s\n' "$key" >.venv/key
