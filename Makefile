# From a clean clone to the paper's table and figure. `make help` lists what there is.
# Every target sets up .venv first, which is silent and instant when there is nothing to do.

# Makes .venv; one that is there keeps the Python that it was made with. Where nobody names one and
# there is none, uv fetches one.
PYTHON ?= python3.11
UV := uv==0.13.8
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
.PHONY: all quick test test-quick test-wheel tables report bench verify cross-cpu kill-test slurm-test archive image-test lint lock audit clean help setup fetched

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

tables: setup ## the tables, figures and verdicts of reference/studies.yaml from its runs, without training
	@$(IN_VENV) tools.tables --cores $(CORES) $(if $(CI),--check)

report: setup ## one page of a kept study, without training: verdicts and figures (STUDY=tuned)
	@$(IN_VENV) tools.tables --cores $(CORES) --report $(or $(STUDY),tuned)

bench: setup ## speed and memory beside others (an hour); BENCH=quick: is a change slower? (minutes)
	@$(call one_of,BENCH,quick)
	@$(IN_VENV) $(if $(BENCH),benchmarks.guard,benchmarks)

verify: setup ## repeat some of the twelve short runs, one each of tuned, plain, our tasks, MiniGrid: to the bit (SAMPLE=3)
	@$(IN_VENV) mace_rl.cli verify reference --sample $(or $(SAMPLE),3)
	folder=$$(mktemp -d)
	trap 'rm -rf "$$folder"' EXIT
	for world in $(wildcard reference/worlds/tuned reference/worlds/plain reference/worlds/tasks reference/worlds/minigrid); do
	    $(IN_VENV) tools.kept_runs unpack "$$world" "$$folder/$${world##*/}" --sample 1 >/dev/null
	done
	$(IN_VENV) mace_rl.cli verify "$$folder" --trust # a rule for β is of extras/

cross-cpu: setup ## train under emulated processors and compare to the bit (half an hour; CROSS=short)
	@$(call one_of,CROSS,short)
	@$(PYTEST) -v -m emulated

kill-test: setup ## kill trainings at bad moments and compare to the bit (minutes)
	@$(IN_VENV) pytest -v -m kill

slurm-test: setup ## the reduced study on a Slurm cluster of one node, compared to the bit (minutes)
	@$(IN_VENV) pytest -sv -m slurm

image-test: ## build Containerfile's image with buildah and run it without network, as root (minutes)
	@.ci/image

archive: setup ## the committed tree with checksums as dist/mace-rl-VERSION.tar, for a DOI
	@$(IN_VENV) tools.deposit

lint: setup ## check style, types and workflow
	@$(IN_VENV) ruff check --no-cache . # an import's place depends on files that a cache does not look at
	$(IN_VENV) ruff format --no-cache --check .
	$(IN_VENV) mypy
	$(IN_VENV) snakefmt --check Snakefile workflow
	$(IN_VENV) tools.lint_workflow
	.venv/bin/actionlint

# --- the environment ------------------------------------------------------------------------------

# Two files in .venv say what it was made from, in their names. The content of the locks counts, not
# their time stamps; and the folder, because neither an environment nor an editable installation
# survives being moved or copied. What was interrupted has no such file and is made anew.
digest = $(shell { pwd; cat $(1); } | sha256sum | head -c 16)
PACKAGES := .venv/packages-$(call digest,environment.lock environment-cuda.lock)
PROJECT := .venv/project-$(call digest,pyproject.toml)
# --no-deps: the locks are complete, and torch's ordinary build must not ask for what is in the
# second one. With build isolation pip would fetch build tools that nothing pins. --no-compile:
# Python makes byte code of what is imported, when it is.
INSTALL := .venv/bin/python -m pip install --no-deps --no-build-isolation --no-compile

# Where else a Python 3.11 may be, if nobody named one.
ELSE := $(if $(filter file,$(origin PYTHON)),python3 "$$PWD"/.python/*/bin/python3.11)

setup: ## only create .venv from environment.lock
	@[ -e .venv/bin/python ] || rm -f .venv/packages-* .venv/project-* # its Python may be gone
	[ ! -e $(PACKAGES) ] || [ ! -e $(PROJECT) ] || exit 0
	exec {lock}>>environment.lock # on a network's disk it has to be open for writing
	flock "$$lock"
	[ ! -e $(PACKAGES) ] || [ ! -e $(PROJECT) ] || exit 0 # made by another one, meanwhile
	export PYTHON
	for PYTHON in "$(PYTHON)" $(ELSE); do
	    ! "$$PYTHON" -c 'import ensurepip, sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null || break
	    PYTHON=
	done
	$(if $(ELSE),[ "$$PYTHON" ] || PYTHON=$$($(MAKE) --silent fetched); [ "$$PYTHON" ] || exit)
	[ "$$PYTHON" ] || {
	    echo "This needs Python 3.11, and '$(PYTHON)' is not, or lacks venv (Debian 12: apt install" \
	        "python3.11-venv): name another, make PYTHON=/path/to/python3.11, or none, and make fetches one" >&2
	    exit 1
	}
	echo "Setting up .venv (once: a minute, or several GB if pip finds no CPU build of torch) ..." >&2
	$(MAKE) --silent $(PROJECT) >setup.log 2>&1 || {
	    tail -n 15 setup.log >&2
	    echo "The set-up failed, as shown; the whole output is in setup.log" >&2
	    exit 1
	}
	rm -f setup.log

# Prints the path of a Python 3.11 that uv has, or brings into .python. A uv that is not there comes
# into an environment that is removed afterwards, made by a Python of any version.
fetched:
	@exec 3>&1 4>&2 >setup.log 2>&1
	failed() {
	    echo "This needs Python 3.11: there is none, and $$1 (setup.log says why). Install it (Debian 12: apt" \
	        "install python3.11-venv; elsewhere pyenv or uv have it) or name it: make PYTHON=/path/to/python3.11" >&4
	    exit 0 # and prints no path: the message is enough
	}
	if command -v uv; then
	    uv=uv
	else
	    folder=$$(mktemp -d)
	    trap 'rm -rf "$$folder"' EXIT
	    python3 -m venv "$$folder" ||
	        failed "python3 makes no environment for uv, which would fetch it (Debian, Ubuntu: apt install python3-venv)"
	    "$$folder/bin/python" -m pip install --quiet $(UV) || failed "pip cannot install uv, which would fetch it"
	    uv=$$folder/bin/uv
	fi
	export UV_PYTHON_PREFERENCE=only-managed UV_PYTHON_INSTALL_BIN=0
	"$$uv" python find --system 3.11 >&3 && exit
	echo "No Python 3.11 here: uv fetches one into .python, for this project alone ..." >&4
	export UV_PYTHON_INSTALL_DIR="$$PWD/.python"
	"$$uv" python install 3.11 || failed "uv cannot fetch it"
	"$$uv" python find --system 3.11 >&3

$(PACKAGES):
	@rm -f .venv/packages-* .venv/project-*
	"$(PYTHON)" -m venv --clear .venv
	pinned() { sed -n "/^$$1==/,/# via/p" environment.lock; }
	# First what builds the packages that exist as source only, then torch's CPU build, if pip sees
	# one: left to itself, pip takes the ordinary build, whose hash an index tells beforehand.
	$(INSTALL) --require-hashes -r <(pinned setuptools)
	$(INSTALL) --require-hashes -r <(pinned torch | sed '1s/^torch==[^ ]*/&+cpu/') ||
	    grep -q 'No matching distribution found for torch' setup.log
	$(INSTALL) --require-hashes -r environment.lock
	if grep '^torch .* not installed' <(.venv/bin/python -m pip check); then
	    $(INSTALL) --require-hashes -r environment-cuda.lock
	fi
	touch $@

$(PROJECT): $(PACKAGES)
	@$(INSTALL) --editable .
	.venv/bin/python -m pip check # fails if pyproject.toml and environment.lock disagree: make lock
	touch $@

# A shell function: run a tool of one package in an environment that is removed afterwards.
define throwaway
folder=$$(mktemp -d)
trap 'rm -rf "$$folder"' EXIT
$(or $(wildcard .venv/bin/python),"$(PYTHON)") -m venv "$$folder"
"$$folder/bin/python" -m pip install --quiet $(1)
endef

# The hash of torch's CPU build for Linux x86-64, several GB smaller than the ordinary one, which the
# resolver cannot see. For another version: pip download --no-deps torch==VERSION && pip hash torch-*
# where pip is set up to see PyTorch's CPU builds.
TORCH := torch==2.13.0
TORCH_CPU_HASH := sha256:6746dbcbeb526eb61330b76b41ff1b4eb848951103a892eeb080dfa2b264667b

lock: ## write environment.lock anew from pyproject.toml (UPGRADE=1: take newer releases)
	@$(call throwaway,$(UV))
	cat environment.lock environment-cuda.lock >"$$folder/lock"
	unset $${!UV_@} # the machine's settings must not show in the lock
	"$$folder/bin/python" -m uv pip compile pyproject.toml --python-version=3.11 \
	    $(addprefix --extra=,study minigrid slurm tensorboard dev) --python-platform=linux --generate-hashes --no-header --no-emit-index-url \
	    --no-emit-find-links --no-config --quiet $(if $(UPGRADE),--upgrade) -o "$$folder/lock"
	grep -q $(TORCH_CPU_HASH) "$$folder/lock" ||
	    sed -i 's/^$(TORCH) .*/&\n    --hash=$(TORCH_CPU_HASH) \\/' "$$folder/lock"
	grep -q $(TORCH_CPU_HASH) "$$folder/lock" || {
	    echo "lock: TORCH_CPU_HASH in the Makefile is not of the torch that was resolved" >&2
	    exit 1
	}
	# What only torch's ordinary build requires goes into the second file.
	for file in environment.lock environment-cuda.lock; do
	    echo '# Written by `make lock` from pyproject.toml: change that, not this file.' >$$file
	done
	awk '/^[^ ]/ { file = /^(cuda-|nvidia-|triton=)/ ? "environment-cuda.lock" : "environment.lock" }
	    { print >>file }' "$$folder/lock"

audit: ## known vulnerabilities of what the locks pin (asks a vulnerability service)
	@$(call throwaway,pip-audit==2.10.1)
	"$$folder/bin/python" -m pip_audit --strict --require-hashes --disable-pip \
	    --progress-spinner=off -r environment.lock -r environment-cuda.lock

clean: ## remove the environments and caches; never results/ or Snakemake's records
	@rm -rf .venv .venv-purejaxrl .python setup.log build src/*.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find benchmarks extras src tests tools workflow -name __pycache__ -prune -exec rm -rf {} +

help: ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
