# Each target sets up all that it needs; only Python 3.11 or later and make must be there.
# make test PYTHON=python3.13 ARGS="-k bank" starts from another Python and passes arguments on.

# Another environment's paths must not leak into ours.
unexport PYTHONPATH
unexport PYTHONHOME
export PYTHON

PY := .venv/bin/python
ARGS :=
# What the emulated wires need beyond Python and its wheels: PortAudio and its ALSA side, an audio server, libusb for
# pyusb, and a compiler for the stand-in of NI's driver library.
TEST_PACKAGES := libportaudio2 libasound2 libasound2-plugins jackd2 libusb-1.0-0 gcc libc6-dev

.PHONY: help demo test test-long lint bench soak clean
.NOTPARALLEL:
.DEFAULT_GOAL := help

help: ## Say what there is
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1\t\2/p' Makefile

demo: ## Measure, interrupt, resume, render, verify on the virtual rig; writes demo-out/
	@tools/set-up.sh
	$(PY) -m wavefocus demo --out demo-out $(ARGS)

test: ## Run the tests, with coverage; some minutes
	@tools/system-packages.sh $(TEST_PACKAGES)
	@tools/set-up.sh test
	@# Python 3.12 and later can measure coverage at next to no cost.
	COVERAGE_CORE=$$($(PY) -c 'import sys; print("sysmon" if sys.version_info >= (3, 12) else "ctrace")') \
		$(PY) -m pytest --cov --cov-report=term $(ARGS)

test-long: ## Run the tests marked long: captures in real time through every emulated wire, benchmarks
	@tools/system-packages.sh $(TEST_PACKAGES)
	@tools/set-up.sh test
	$(PY) -m pytest -m long $(ARGS)

lint: ## Check style, types and import directions
	@tools/set-up.sh lint
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy
	.venv/bin/lint-imports

bench: ## Error against run time, ours beside peers; writes bench-out/
	@tools/set-up.sh bench
	$(PY) -m wavefocus bench all --out bench-out $(ARGS)

soak: ## Kill, cut the power, fill disks and flip bytes by the thousand; half an hour on 2 idle cores; writes soak-out/
	@tools/system-packages.sh gcc libc6-dev
	@tools/set-up.sh test
	$(PY) -m tests.system.crash.soak --out soak-out

clean: ## Remove .venv, caches and what demo and bench wrote
	rm -rf .venv .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis .coverage .coverage.* \
		htmlcov build dist *.egg-info demo-out bench-out soak-out
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
