# Every target makes .venv and installs what it needs, once; it is done again when pyproject.toml changes.

# Interpreter to make .venv with; empty: the first Python >= 3.10 among python3, python3.13, ... python3.10.
PYTHON ?=
# Installed first when .venv has no torch. The index is used for torch alone; empty: pip's own.
TORCH ?= torch==2.13.0
TORCH_INDEX ?=
# Surface for the demo; empty: the one that the demo brings.
MESH ?=
# Limit shapes for the benchmarks (benchmarks/README.md says what they hold); empty: those that need none.
SHAPES ?=

BIN := .venv/bin

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.NOTPARALLEL:
.PHONY: help demo test lint format docs pictures bench clean

help: ## show this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-8s %s\n", $$1, $$2 }' Makefile

demo: .venv/installed-demo ## run the demo, on a mesh of yours with MESH=path
	$(BIN)/python examples/demo.py $(if $(MESH),--mesh "$(MESH)")

test: lint ## lint, types, tests, doctests, examples
	$(BIN)/python -m pytest -n auto --maxprocesses 8 --dist worksteal

lint: .venv/installed-dev ## ruff and pyright
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright

format: .venv/installed-dev ## put the files in ruff's format
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

docs: .venv/installed-dev ## build the documentation into site/
	$(BIN)/mkdocs build --strict

pictures: .venv/installed-dev ## draw the pictures of docs/ again
	MPLBACKEND=Agg $(BIN)/python scripts/draw_docs.py

bench: .venv/installed-bench ## run the benchmarks, with SHAPES="a.npz b.npz" those on limit shapes, too
	@for file in accuracy curvature device isospectralization layers learning robustness speed tangent_fields tangent_learning; do \
		$(BIN)/python benchmarks/$$file.py || exit 1; done
	@for file in $(if $(SHAPES),clouds conductivity limit_shapes) media time_to_accuracy; do \
		$(BIN)/python benchmarks/$$file.py $(SHAPES) || exit 1; done
	@$(BIN)/python benchmarks/reliability.py

clean: ## remove .venv, caches and build products
	rm -rf .venv build dist site .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# A stamp per extra of pyproject.toml, written only after a complete install. dev and bench contain demo.
.venv/installed-%: pyproject.toml scripts/setup_venv.sh
	PYTHON="$(PYTHON)" TORCH="$(TORCH)" TORCH_INDEX="$(TORCH_INDEX)" sh scripts/setup_venv.sh $*
	touch $@ $(if $(filter dev bench,$*),.venv/installed-demo)
