# Each target sets up all that it needs; only Python 3.11 or later and make must be there.
# make test PYTHON=python3.13 ARGS="-k bank" starts from another Python and passes arguments on.

# Another environment's paths must not leak into ours.
unexport PYTHONPATH
unexport PYTHONHOME
# Without compiled files each of the many processes of demo and tests would compile every module anew: a second each.
unexport PYTHONDONTWRITEBYTECODE
export PYTHON

PY := .venv/bin/python
ARGS :=
# What a window needs on a bare system: Qt's own libraries and a font; and, for a test with a real X server, the rest.
WINDOW_PACKAGES := libgl1 libglib2.0-0 libfontconfig1 fonts-dejavu-core
X_PACKAGES := xvfb xauth libdbus-1-3 libxcb-icccm4 libxcb-image0 libxcb-keysyms1 libxcb-render-util0 libxcb-shape0 \
	libxcb-xinerama0 libxcb-xkb1 libxkbcommon-x11-0
# What compiles the stand-in of NI's driver library.
COMPILER := gcc libc6-dev
# What the emulated wires need beyond Python and its wheels: PortAudio and its ALSA side, an audio server, libusb for pyusb.
TEST_PACKAGES := libportaudio2 libasound2 libasound2-plugins jackd2 libusb-1.0-0 $(COMPILER) \
	$(WINDOW_PACKAGES) $(X_PACKAGES)

# Octave reads a bank in a nightly test; what it recommends (Java, for one) is not needed.
OCTAVE := octave octave-netcdf

# What `make test` runs, collected from no other files: whole folders, and the files with a test of a command or a tab.
QUICK = -m "not long and not whole and not nightly" tests/unit tests/wire tests/contract $(shell grep -rl "mark.smoke" tests/system tests/gui)

.PHONY: help demo docs test test-all test-nightly constraints lint bench bench-pages stiff-cases soak screenshots clean
.NOTPARALLEL:
.DEFAULT_GOAL := help

help: ## Say what there is
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1\t\2/p' Makefile

demo: ## Measure, interrupt, resume, render, verify on the virtual rig; writes demo-out/
	@tools/set-up.sh plates
	$(PY) -m wavefocus demo --out demo-out --force $(ARGS)

docs: ## Build the documentation's site in site/, warnings being errors; open site/index.html
	@tools/set-up.sh docs
	$(PY) -m sphinx -W -E --keep-going -q docs site

test: ## Run unit, contract and wire tests, and one test of each command and tab
	@tools/system-packages.sh $(TEST_PACKAGES)
	@tools/set-up.sh test
	$(PY) -m pytest --dist loadfile $(QUICK) $(ARGS)

test-all: ## Run the tests that `make test` leaves out: whole commands, kills, captures in real time
	@tools/system-packages.sh $(TEST_PACKAGES)
	@tools/set-up.sh test-all
	$(PY) -m pytest --dist loadfile -m "(whole or long) and not nightly" $(ARGS)

test-nightly: ## Benchmarks, mutations, commands of all pages, properties on new cases, coverage, soak; some 80 minutes
	@tools/system-packages.sh $(TEST_PACKAGES)
	@tools/system-packages.sh --no-install-recommends $(OCTAVE)
	@tools/set-up.sh test-all
	@tools/set-up.sh bench
	COVERAGE_CORE=$$($(PY) -c 'import sys; print("sysmon" if sys.version_info >= (3, 12) else "ctrace")') \
		$(PY) -m pytest $(QUICK) --hypothesis-profile nightly --cov --cov-report=term $(ARGS)
	$(PY) -m pytest -m nightly --dist worksteal $(ARGS)

constraints: ## Renew constraints.txt with the newest versions of what wavefocus and its tests need, and run the tests
	: >constraints.txt
	rm -rf .venv
	for extra in test-all lint docs bench; do tools/set-up.sh $$extra || exit 1; done
	$(PY) -m pip --disable-pip-version-check freeze --exclude wavefocus >constraints.txt
	$(MAKE) test

lint: ## Check style, types and import directions
	@tools/set-up.sh lint
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy
	.venv/bin/lint-imports

bench: ## Measure error against run time, the paper's figures, stiff cases; writes bench-out/ and their pages in docs/
	@tools/set-up.sh bench
	@tools/set-up.sh test
	OMP_NUM_THREADS=1 $(PY) -m wavefocus bench all --out bench-out --force $(ARGS)
	OMP_NUM_THREADS=1 $(PY) -m wavefocus bench paper --out bench-out --force $(ARGS)
	@# Figures of a quick run are no figures: they stand nowhere.
	$(if $(findstring quick,$(ARGS)),@echo "a quick run: no page is written",$(PY) tools/benchmark_pages.py bench-out)
	$(if $(findstring quick,$(ARGS)),,$(PY) tools/stiff_cases.py)

bench-pages: ## Write the benchmarks' pages in docs/ anew from bench-out/
	$(PY) tools/benchmark_pages.py bench-out

stiff-cases: ## Run the stiff and extreme cases and write their page in docs/
	@tools/set-up.sh test
	$(PY) tools/stiff_cases.py

soak: ## Kill, cut the power, fill disks and flip bytes by the thousand; 40 minutes on 2 idle cores
	@tools/system-packages.sh $(COMPILER)
	@tools/set-up.sh test
	$(PY) -m pytest -m nightly --dist worksteal -rP tests/system/test_soak.py $(ARGS)

screenshots: ## Take pictures of the window; writes docs/pictures/window-*.png
	@tools/system-packages.sh $(WINDOW_PACKAGES) $(X_PACKAGES)
	@tools/set-up.sh window
	$(PY) tools/screenshots.py docs/pictures $(ARGS)

clean: ## Remove .venv, caches and what demo and bench wrote
	rm -rf .venv .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis .coverage .coverage.* \
		htmlcov build dist *.egg-info demo-out bench-out site
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
