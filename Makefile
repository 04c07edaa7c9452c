# Every target makes its own environment in .venv; nothing but Python 3.11+ and make is needed beforehand.
PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

.PHONY: help demo test test-all lint bench docs site clean

help:
	@echo "make demo      simulate a small Falcon and LWR course, ingest it, write reports/*.html"
	@echo "make test      lint, type check and the fast tests"
	@echo "make test-all  the slow tests too"
	@echo "make bench     speed and memory of ingest, theory, comparisons and watch, at thesis size; trials that the planner needs"
	@echo "make docs      regenerate schemas/*.json, the nomenclature and all images but that of falcon.md, which takes hours"
	@echo "make site      build the documentation as pages with a search that needs no network: build/site"
	@echo "make clean     remove environment, caches and the demo's logs and tables (what you recorded and ingested, and reports/, are kept)"

.venv/.run: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(PIP) -e .
	$(BIN)/python -m compileall -q pipeline
	@touch $@

.venv/.dev: .venv/.run
	$(PIP) -e '.[dev]'
	@touch $@

demo: .venv/.run
	$(BIN)/pipeline demo

lint: .venv/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: lint
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist loadfile -m "not slow"

test-all: lint
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist loadfile

.venv/.bench: .venv/.dev
	$(PIP) -e '.[bench]'
	@touch $@

bench: .venv/.bench
	$(BIN)/python benchmarks/spine.py
	$(BIN)/python benchmarks/theory.py
	$(BIN)/python benchmarks/watch.py
	$(BIN)/python benchmarks/growth.py
	$(BIN)/python benchmarks/rows.py
	$(BIN)/python benchmarks/plan.py

docs: .venv/.dev
	$(BIN)/python docs/make_schemas.py
	$(BIN)/python docs/make_nomenclature.py
	$(BIN)/python docs/make_figure.py
	$(BIN)/python docs/make_scatter.py
	$(BIN)/python docs/make_identification.py
	$(BIN)/python docs/make_gallery.py
	$(BIN)/python docs/make_tutorial.py
	$(BIN)/python docs/make_notebook.py
	$(BIN)/python docs/make_screens.py
	$(BIN)/python docs/made_from.py

site: .venv/.dev
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs build/site
	@echo "build/site/index.html"

clean:
	rm -rf .venv raw/demo processed/demo .pytest_cache .mypy_cache .ruff_cache .hypothesis dist
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
