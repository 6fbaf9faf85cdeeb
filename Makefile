# `make demo` and `make test` do all set-up by themselves; both are quick when it is done already.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed

.PHONY: install demo docs dist test quick gpu test-slow test-oracles golden lint types format clean

install: $(STAMP)

$(STAMP): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Foredrive needs Python 3.11 or newer; this is Python " + sys.version.split()[0] + ". Name another with: make PYTHON=python3.12 ...")'
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[dev]"
	@touch $(STAMP)

demo: install
	$(BIN)/foredrive demo

# The site, from the pages, the docstrings and benchmarks/results; a broken link or docstring is an error.
DOCS_STAMP := .venv/.installed-docs

$(DOCS_STAMP): $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[docs]"
	@touch $@

docs: $(DOCS_STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "open build/site/index.html"

# Wheel and sdist, of the version that a tag of this commit names; the wheel is installed into an empty environment and tried there, the quick demo included.
dist: install
	@$(BIN)/python -c 'import sys, foredrive; own = "v" + foredrive.__version__; tags = [tag for tag in sys.argv[1:] if tag != own]; sys.exit(f"This is {own}, not {tags[0]}: the version and the tag differ" if tags else 0)' \
		$$(git tag --points-at HEAD --list 'v*')
	rm -rf dist
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "build>=1.2"
	$(BIN)/python -m build --outdir dist .
	FOREDRIVE_WHEEL=$$(echo dist/*.whl) $(BIN)/python -m pytest -m slow tests/test_package.py
	@du -h dist/*

lint: types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: install
	$(BIN)/mypy

format: install
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Files of tests side by side on up to four cores, each in a process with one thread.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder
# Folders of tests without processes, logs, towns and training; 40 s on two cores.
QUICK := $(addprefix tests/, geometry scene sensors sets tasks search test_architecture.py)

test: install lint
	$(PYTEST) -m "not slow"

# Units only, for the inner loop.
quick: install
	$(PYTEST) -m "not slow" $(QUICK)

# Kernels against their references, then speeds, on a GPU; sized for 8 minutes. The figures go to benchmarks/results/gpu.json.
gpu: install
	@$(BIN)/python -c 'import sys, torch; sys.exit(0 if torch.cuda.is_available() else f"no GPU here that PyTorch {torch.__version__} can use: nothing was measured")'
	$(BIN)/python -m pytest tests/ops
	$(BIN)/python -m benchmarks.gpu

# The studies that `make test` leaves out.
test-slow: install
	$(PYTEST) -m slow

# Reference code of other people, in an environment of its own that sees the packages of .venv.
# The devkit's own requirements are older than ours, so each package is installed without its dependencies.
ORACLES := nuscenes-devkit==1.2.0 motmetrics==1.4.0 trackeval==1.3.0 xmltodict cachetools pyquaternion \
	av2==0.3.6 universal-pathlib pathlib-abc polars polars-runtime-32 kornia kornia-rs click tqdm
ORACLE_STAMP := .venv-oracles/.installed

$(ORACLE_STAMP): $(STAMP)
	$(BIN)/python -m venv .venv-oracles
	.venv-oracles/bin/python -m pip install --quiet --disable-pip-version-check --no-deps $(ORACLES)
	$(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))' \
		> "$$(.venv-oracles/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/foredrive.pth"
	@touch $(ORACLE_STAMP)

# Our metrics beside the reference code itself, and beside figures of code that cannot be installed. Nothing is
# skipped here: what is missing is an error. `make test` compares with figures of both, in golden.json and reference/.
test-oracles: $(ORACLE_STAMP)
	FOREDRIVE_ORACLES=1 PYTHONPATH=src OMP_NUM_THREADS=1 .venv-oracles/bin/python -m pytest tests/oracles

golden: $(ORACLE_STAMP)
	PYTHONPATH=src:tests:. .venv-oracles/bin/python tests/oracles/make_golden.py
	PYTHONPATH=src:tests:. .venv-oracles/bin/python tests/oracles/av2_forecasting.py

clean:
	rm -rf .venv .venv-oracles runs build dist
	find src tests benchmarks -name '*.nb[ic]' -delete
