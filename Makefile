# From a clean clone to the paper's table and figure. `make help` lists what there is.
# Every target sets up .venv first, which is silent and instant when there is nothing to do.

# Makes .venv; one that is there keeps the Python that it was made with. Where nobody names one,
# tools/setup looks for it.
PYTHON ?=
# How many jobs, or processes of tests, run at once: a number, or all the machine has.
CORES ?= all

SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.ONESHELL:
# Everything is UTF-8, whatever the locale says.
export PYTHONUTF8 := 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PIP_NO_INPUT := 1
# Where it is set, every process compiles its imports anew, which takes longer than running them.
unexport PYTHONDONTWRITEBYTECODE
unexport CDPATH PYTHONHOME PYTHONPATH PIP_PREFIX PIP_REQUIRE_HASHES PIP_TARGET PIP_USER

# A command inside the environment. `python -m` also works where the folder's name has a space.
IN_VENV := PATH="$$PWD/.venv/bin:$$PATH" .venv/bin/python -m
SNAKEMAKE := $(IN_VENV) snakemake --cores $(CORES)
# Each process of the tests takes some 400 MB.
PYTEST := $(IN_VENV) pytest -n $(if $(filter all,$(CORES)),auto,$(CORES)) --maxprocesses 8

# $(call one_of,NAME,VALUE): stop where the variable has another value.
one_of = $(if $(filter-out $(2),$($(1))),$(error $(1) is '$($(1))', but should be $(2) or not be given))

.DEFAULT_GOAL := all
.PHONY: all quick test test-quick test-wheel tables bench verify cross-cpu kill-test slurm-test image-test lint lock audit clean help setup

all: setup ## the paper's study: every run, table and figure, at the paper's budgets (hours)
	@$(SNAKEMAKE) all

quick: setup ## the same at small budgets, to see it work (minutes)
	@$(SNAKEMAKE) all --configfile config/reduced.yaml

test: setup ## every test but those of cross-cpu, kill-test and slurm-test, on up to 8 cores
	@$(PYTEST)

test-quick: setup ## the tests that take seconds, for the edit loop
	@$(PYTEST) -m "not slow" # which those are, too

test-wheel: setup ## the wheel in environments of its own: newest, lowest, Debian 13 (minutes)
	@.ci/wheel

tables: setup ## the tables, figures and verdicts of the studies that are kept, without training
	@$(IN_VENV) tools.tables --cores $(CORES) $(if $(CI),--check)

bench: setup ## speed and memory beside others (an hour); BENCH=quick: is a change slower? (minutes)
	@$(call one_of,BENCH,quick)
	@$(IN_VENV) $(if $(BENCH),benchmarks.guard,benchmarks)

verify: setup ## repeat some of the twelve short runs, one each of tuned, plain, our tasks, MiniGrid: to the bit (SAMPLE=3)
	@$(IN_VENV) mace_rl verify reference --sample $(or $(SAMPLE),3)
	for world in tuned plain tasks minigrid; do
	    $(IN_VENV) tools.kept_runs verify reference/worlds/$$world --sample 1
	done

cross-cpu: setup ## train under emulated processors and compare to the bit (half an hour; CROSS=short)
	@$(call one_of,CROSS,short)
	@$(PYTEST) -v -m emulated

kill-test: setup ## kill trainings at bad moments and compare to the bit (minutes)
	@$(PYTEST) -v -m kill

slurm-test: setup ## the reduced study on a Slurm cluster of one node, compared to the bit (minutes)
	@$(IN_VENV) pytest -sv -m slurm

image-test: ## build Containerfile's image with buildah and run it without network, as root (minutes)
	@.ci/image

lint: setup ## check style, types and workflow
	@$(IN_VENV) ruff check --no-cache . # an import's place depends on files that a cache does not look at
	$(IN_VENV) ruff format --no-cache --check .
	$(IN_VENV) mypy
	$(IN_VENV) snakefmt --check Snakefile workflow
	.venv/bin/actionlint

setup: ## only create .venv from environment.lock
	@tools/setup $(if $(PYTHON),"$(PYTHON)")

lock: ## write environment.lock anew from pyproject.toml (UPGRADE=1: take newer releases)
	@tools/lock $(if $(UPGRADE),--upgrade)

audit: setup ## known vulnerabilities of what the locks pin (asks a vulnerability service)
	@folder=$$(mktemp -d)
	trap 'rm -rf "$$folder"' EXIT
	.venv/bin/python -m venv "$$folder"
	"$$folder/bin/python" -m pip install --quiet pip-audit==2.10.1
	"$$folder/bin/python" -m pip_audit --strict --require-hashes --disable-pip \
	    --progress-spinner=off -r environment.lock -r environment-cuda.lock

clean: ## remove the environments and caches; never results/ or Snakemake's records
	@rm -rf .venv .venv-purejaxrl .python setup.log build src/*.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find benchmarks extras src tests tools workflow -name __pycache__ -prune -exec rm -rf {} +

help: ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
