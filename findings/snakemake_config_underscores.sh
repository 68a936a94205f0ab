#!/usr/bin/env bash
# snakemake 9.27.1: a text on the command line that looks like digits with underscores is a number.
# Expected: `--config results=2024_11_25` names a folder by a date, as it is typed, and as the same
#   line in a configuration file does by YAML 1.2.
# Behaviour: values are read as YAML 1.1's, in which underscores only group digits.
# Seen: int 20241125
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q snakemake==9.27.1
cd "$folder"
cat >Snakefile <<'SNAKEMAKE'
rule all:
    output:
        "said.txt",
    run:
        value = config["results"]
        open(output[0], "w").write(f"{type(value).__name__} {value}")
SNAKEMAKE
PATH="$folder/env/bin:$PATH" snakemake -j1 --quiet all --config results=2024_11_25 >log 2>&1 || cat log
found=$(cat said.txt)
echo "$found"
[ "$found" = "int 20241125" ]
