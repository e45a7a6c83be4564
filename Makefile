# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later

# The environment: made where it is missing, used as it is where it exists.
VENV ?= .venv
# The interpreter to make it with (empty: look for one).
PYTHON ?=
# Numbers of ranks of the further runs of the tests (1: no further run; empty: 2 3, of all tests
# 2 3 4), and arguments for pytest.
NP ?=
ARGS ?=

export PYTHON VENV NP
export OMP_NUM_THREADS := 1
# Some containers forbid it: then each process, of some dozens, compiles all modules again.
unexport PYTHONDONTWRITEBYTECODE

# Where compiled forms are kept, if not at home.
ifneq ($(shell d="$${XDG_CACHE_HOME:-$$HOME/.cache}"; mkdir -p "$$d" 2>/dev/null && test -w "$$d" && echo yes),yes)
export XDG_CACHE_HOME := $(CURDIR)/build/cache
endif

BIN := $(VENV)/bin
SETUP := sh scripts/setup_env.sh

# Benchmarks that print a JSON object; work_precision.py writes its results and pictures itself.
BENCHMARKS := $(wildcard $(patsubst %,benchmarks/%.py,assembly step contact skip solvers multigrid choice scaling ranks cantilever_reference))

.DEFAULT_GOAL := help
.PHONY: help demo demos test test-all test-debian stress bench bench-smoke studies lint docs paper serve dist
.PHONY: test-dist clean

help: ## This list
	@echo "make TARGET [VENV=path of an environment] [PYTHON=path of an interpreter]"
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  %-11s %s\n", $$1, $$2 }' Makefile

demo: ## Install what is needed, run the first demo, make its picture
	@$(SETUP) wheel plot
	@mkdir -p output
	cd output && "$(abspath $(BIN)/python)" ../demos/demo_column_roller.py
	@echo "The picture is output/column_roller.png"

test: ## Ten minutes: the quick tests on 1, then on NP="2 3" ranks (ARGS=tests/materials: seconds)
	@$(SETUP) wheel plot test adjoint
	@bash scripts/run_tests.sh $(ARGS)

test-all: ## An hour: all tests on 1, then on NP="2 3 4" ranks, and without ARGS the stress suite
	@$(SETUP) wheel plot test adjoint
	@bash scripts/run_tests.sh --all $(ARGS)
	@$(if $(ARGS),,cd tests && "$(abspath $(BIN)/python)" -m stress.run)

test-debian: ## As root: the tests with Debian's DOLFINx 0.9, in a root made by debootstrap
	@bash scripts/test_debian.sh $(ARGS)

stress: ## Run the stress suite and report (ARGS="--only offset flow" for some classes)
	@$(SETUP) wheel plot test
	@cd tests && "$(abspath $(BIN)/python)" -m stress.run $(ARGS)

bench: ## Run all benchmarks: benchmarks/results/*.json and the pictures of run time against error
	@$(SETUP) wheel plot
	@mkdir -p benchmarks/results
	@set -e; for script in $(BENCHMARKS); do \
	    name=$$(basename "$$script" .py); \
	    echo "$$script"; \
	    "$(BIN)/python" "$$script" --json >"benchmarks/results/$$name.new"; \
	    mv "benchmarks/results/$$name.new" "benchmarks/results/$$name.json"; \
	done
	"$(BIN)/python" benchmarks/work_precision.py

bench-smoke: ## Run all benchmarks at tiny sizes, in less than a minute
	@$(SETUP) wheel plot
	@set -e; for script in $(BENCHMARKS) benchmarks/work_precision.py; do \
	    echo "$$script --smoke"; "$(BIN)/python" "$$script" --smoke; \
	done

studies: ## Make the tables of the docs again, say which no longer follow (ARGS="--check" runs few)
	@$(SETUP) wheel plot test
	"$(BIN)/python" docs/studies/make.py $(ARGS)

demos: ## Run the demos (ARGS="footing collapse" some), keep their pictures and outputs for the docs
	@$(SETUP) wheel plot
	"$(BIN)/python" scripts/run_demos.py $(ARGS)

dist: ## Source distribution and wheel in dist/, looked at by twine and auditwheel
	@$(SETUP) dist
	@bash scripts/make_dist.sh

test-dist: dist ## The wheel of dist/ in an environment of its own, outside of this tree
	@bash scripts/test_wheel.sh

lint: ## ruff check, ruff format --check, mypy
	@$(SETUP) wheel plot test
	"$(BIN)/ruff" check .
	"$(BIN)/ruff" format --check .
	"$(BIN)/mypy"

docs: ## Build the documentation into site/
	@$(SETUP) docs
	NO_MKDOCS_2_WARNING=1 "$(BIN)/python" -m mkdocs build --strict
	@echo "The documentation starts at site/index.html"

paper: ## Make the paper's PDF, output/paper.pdf
	@$(SETUP) paper
	@"$(BIN)/python" scripts/make_paper.py

serve: ## Show the documentation, with its search, at http://127.0.0.1:8000
	@$(SETUP) docs
	NO_MKDOCS_2_WARNING=1 "$(BIN)/python" -m mkdocs serve

clean: ## Remove what the targets made, except the environment
	rm -rf build dist output site .mypy_cache .pytest_cache .ruff_cache
	find $(wildcard benchmarks demos docs mpm_dolfinx tests) -name __pycache__ -type d -prune -exec rm -rf {} +
