# What each target does: `make help`. Everything happens in .venv; nothing else on the machine is touched.
.DEFAULT_GOAL := help
.PHONY: help venv demo guide test test-all lint docs

BIN := .venv/bin
STAMP := .venv/installed
CORES ?= 2

help:  ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-8s %s\n", $$1, $$2}' Makefile

venv: $(STAMP)  ## .venv with the locked version of everything, extras included
	@echo 'Done. Next: make demo, or $(BIN)/vinetrack setup FOLDER'

demo: $(STAMP)  ## 24 recordings, made in the virtual laboratory on first use, to results/demo/report.html
	@$(BIN)/vinetrack run data/demo --cores $(CORES)

guide: demo  ## outputs and pictures of the docs, printed and drawn anew from the demonstration
	$(BIN)/python benchmarks/guide_pages.py

# Told to keep no compiled modules, each process that tests start would compile the package anew. One thread of linear
# algebra in each of as many processes as there are cores: more would wait for each other.
TESTS := PYTHONDONTWRITEBYTECODE= OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n $(CORES) --dist worksteal

test: $(STAMP)  ## the tests of every day
	$(TESTS) -m "not slow"

test-all: $(STAMP)  ## all tests, with the slow ones: browsers, killed runs, whole experiments
	$(TESTS)

lint: $(STAMP)  ## style, types and the workflow's formatting
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/snakefmt --check Snakefile vinetrack/pipeline/Snakefile

docs: $(STAMP)  ## the documentation with the Python interface as a site, build/site/tutorial.html
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements-docs.lock
	@$(BIN)/mkdocs build --quiet --strict

# The stamp is written last: an installation that was broken off starts again. The package is installed by its path,
# which Python prefers to a folder without it: a script beside a clone named vinetrack would else take that for it.
$(STAMP): requirements.lock pyproject.toml
	@python=''; for candidate in $(PYTHON) python3.11 python3.12 python3.13 python3.14 python3; do \
	  if "$$candidate" -c 'import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; \
	  then python=$$candidate; break; fi; done; \
	if [ -z "$$python" ]; then \
	  echo 'vinetrack needs Python 3.11 or newer with its venv module, and found none. Install one' >&2; \
	  echo '(Debian, Ubuntu: apt install python3-venv), or name it: make PYTHON=/path/to/python3 $(MAKECMDGOALS)' >&2; \
	  exit 1; fi; \
	echo "Setting up .venv with $$("$$python" --version), about a minute the first time."; \
	rm -f $(STAMP); $(BIN)/python -c '' 2>/dev/null || "$$python" -m venv --clear .venv
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation \
	  --config-settings editable_mode=compat --editable .
	@touch $(STAMP)
