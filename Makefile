# From a clean clone to the paper's table and figure. `make help` lists what there is.
# Every target sets up .venv first, which is silent and instant when there is nothing to do.

PYTHON ?= python3.11
export PYTHON
# Everything is UTF-8, whatever the locale says.
export PYTHONUTF8 := 1
unexport PYTHONHOME PYTHONPATH

# A command inside the environment. `python -m` also works where the folder's name has a space.
IN_VENV := PATH="$$PWD/.venv/bin:$$PATH" .venv/bin/python -m
SNAKEMAKE := $(IN_VENV) snakemake

.DEFAULT_GOAL := all
.PHONY: all quick test bench verify kill-test lint lock bench-lock audit clean help setup

all: setup ## the paper's study: every run, table and figure, at the paper's budgets (hours)
	@$(SNAKEMAKE) -j2 all

quick: setup ## the same at small budgets, to see it work (minutes)
	@$(SNAKEMAKE) -j2 all --configfile config/reduced.yaml

test: setup ## every test
	@$(IN_VENV) pytest

bench: setup ## speed and memory beside stable-baselines3 (40 minutes; BENCH=quick: a few)
	@benchmarks/setup.sh
	@benchmarks/.venv/bin/python -m benchmarks $(if $(filter quick,$(BENCH)),--quick)

verify: setup ## repeat a sample of the runs in reference/ and compare to the bit (SAMPLE=3)
	@.venv/bin/python -m mace_rl.cli verify reference --sample $(or $(SAMPLE),3)

kill-test: setup ## kill trainings and workflows at bad moments and compare to the bit (minutes)
	@PATH="$$PWD/.venv/bin:$$PATH" .venv/bin/python tools/kill_test.py

lint: setup ## check style and workflow
	@$(IN_VENV) ruff check .
	@$(IN_VENV) ruff format --check .
	@$(IN_VENV) snakefmt --check Snakefile workflow
	@.venv/bin/python tools/lint_workflow.py

setup: ## only create .venv from environment.lock
	@tools/setup.sh

lock: ## write environment.lock anew from pyproject.toml (UPGRADE=1: take newer releases)
	@tools/in_throwaway_venv.sh uv==0.13.8 tools/lock.py $(if $(UPGRADE),--upgrade)

bench-lock: ## write benchmarks/environment.lock anew from benchmarks/requirements.txt
	@tools/in_throwaway_venv.sh uv==0.13.8 benchmarks/lock.py

audit: ## known vulnerabilities of what the locks pin (asks a vulnerability service)
	@tools/in_throwaway_venv.sh pip-audit==2.10.1 tools/audit.py

clean: ## remove .venv and caches; never results/ or Snakemake's records
	@rm -rf .venv benchmarks/.venv .venv.lock setup.log build src/*.egg-info .hypothesis .pytest_cache .ruff_cache
	@find benchmarks src tests tools workflow -name __pycache__ -prune -exec rm -rf {} + 2>/dev/null || true

help: ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
