#!/usr/bin/env bash
# snakemake 9.27.1: whether an input that was merely touched makes a job run again hangs on its size.
# Expected: one rule for all files. Touched and equal files either count as new or do not.
# Behaviour: up to a megabyte (--max-checksum-file-size) files are compared by a checksum, and a touch
#   changes nothing; a larger one counts as new by its time alone.
# Seen: small 0 jobs, large 1 job
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q snakemake==9.27.1
cd "$folder"
cat >Snakefile <<'SNAKEMAKE'
rule copy:
    input:
        "{size}.csv",
    output:
        "{size}.out",
    shell:
        "cp {input} {output}"
SNAKEMAKE
export PATH="$folder/env/bin:$PATH"
head -c 900000 /dev/zero >small.csv
head -c 1100000 /dev/zero >large.csv
snakemake -j1 --quiet all -- small.out large.out >log 2>&1 || cat log
sleep 1.1 # another time stamp
touch small.csv large.csv
jobs() { snakemake -n "$1" 2>&1 | grep -c '^rule copy:' || true; }
found="small $(jobs small.out) jobs, large $(jobs large.out) job"
echo "$found"
[ "$found" = "small 0 jobs, large 1 job" ]
