# `make leaderboard` and `make test` do all their own set-up: a virtual environment, the install,
# the work. PYTHON names the interpreter (3.11 to 3.13); JOBS the processes (one a core).
PYTHON ?= python3
VENV ?= .venv
PRESET ?= standard
# The smoke preset's few steps are no scores: they stay out of the leaderboard.
RESULTS := $(if $(filter smoke,$(PRESET)),results/smoke,leaderboard/results)
BOARD := $(if $(filter smoke,$(PRESET)),results/smoke-board,leaderboard)
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: help leaderboard check test lint wheel site clean
.DEFAULT_GOAL := help

help:
	@echo "make leaderboard   fit the baselines on LASA and the letters, score them, write leaderboard/LEADERBOARD.md"
	@echo "                   (PRESET=smoke|standard|full, default standard; what is up to date is not done again)"
	@echo "make check         check leaderboard/results: records, hashes, the board that they make"
	@echo "make test          run the tests, the linter and the type checker"
	@echo "make wheel         build the wheel, install it into an empty environment, try it there"
	@echo "make site          build the documentation into site/, warnings are errors"

$(STAMP): pyproject.toml constraints.txt
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "Installing into $(VENV) ..."
	@$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[test,dev,docs]'
	@touch $@

# A failed cell has its place on the board, so the board is built then, too.
leaderboard: $(STAMP)
	@status=0; \
	$(BIN)/python baselines/run_all.py --preset $(PRESET) $(if $(JOBS),--jobs $(JOBS)) \
	    --output $(RESULTS) || status=$$?; \
	if [ $$status -gt 1 ]; then exit $$status; fi; \
	$(BIN)/python leaderboard/build.py --results $(RESULTS) --output $(BOARD) && exit $$status

# Files alone: `--cells 3` would score some cells of each method again, which takes minutes.
check: $(STAMP)
	$(BIN)/python -m iflow_gym.leaderboard check leaderboard/results --cells 0
	@if $(BIN)/python leaderboard/build.py --help | grep -q -- --check; then \
	    echo "leaderboard/build.py --check"; $(BIN)/python leaderboard/build.py --check; fi

test: lint
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest --quiet --numprocesses 2

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

wheel: $(STAMP)
	VENV=$(VENV) PYTHON=$(PYTHON) tests/wheel.sh

# SITE_URL and SOURCE_URL may be set: see mkdocs.yml.
site: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict --site-dir site
	@echo "site/index.html; with a search: $(BIN)/python -m http.server --directory site"

clean:
	rm -rf $(VENV) site build dist *.egg-info results
