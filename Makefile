# `make demo` and `make test` do all the set-up themselves.
ZEST := .venv/bin/zest
PYTEST := OMP_NUM_THREADS=1 .venv/bin/python -m pytest --durations=15

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-slow test-interop lint bench tables hero docs clean

help: ## list the targets
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/  make \1|\2/' | column -t -s '|'

setup: .venv/.complete ## make .venv with the tested versions, and install the GL libraries if they are missing

.venv/.complete: pyproject.toml constraints.txt .ci/setup.sh
	.ci/setup.sh
	touch $@

demo: setup ## reproduce one task end to end and write its report; offline after the set-up
	$(ZEST) reproduce demo

test: lint ## lint and all quick tests
	-.ci/setup.sh browser
	$(PYTEST) -n 2 --dist loadfile -m "not slow"

test-slow: setup .venv/.docs ## the tests that take longer than a minute each, and the tutorials that are notebooks
	$(PYTEST) -m slow
	$(PYTEST) --nbmake docs/tutorials

CONSUMERS := d3rlpy torchrl robomimic corl lerobot
test-interop: setup ## exports in d3rlpy, TorchRL, robomimic, CORL, LeRobot, each in a venv of its own; CONSUMERS="…" for some
	tests/interop/run.sh $(CONSUMERS)

lint: setup ## ruff and mypy
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy

bench: setup ## compare speeds with other implementations
	.venv/bin/python -m benchmarks

tables: setup ## write the tables of README.md, docs/results.md and eval/README.md, and their figures, from eval/results
	.venv/bin/python docs/tables.py
	.venv/bin/python docs/figures.py

hero: setup ## make the README's pictures; the moving one is from runs/demo, the output of make demo
	.venv/bin/python docs/task_sheet.py
	.venv/bin/python docs/hero.py

docs: setup .venv/.docs ## the documentation as a site, in site/index.html; a dead link is an error
	NO_MKDOCS_2_WARNING=1 .venv/bin/python -m mkdocs build --strict

.venv/.docs: .venv/.complete
	.venv/bin/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[docs]'
	touch $@

clean: ## remove caches and builds; keeps .venv, .venvs, runs and datasets
	rm -rf .mypy_cache .ruff_cache .pytest_cache .hypothesis build dist site
	find . -name __pycache__ -not -path './.venv*/*' -prune -exec rm -rf {} +
