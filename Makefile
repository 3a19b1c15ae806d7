# `make demo` and `make test` are all the set-up: both make .venv and install what they need.

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check -qq
INSTALL := $(PIP) install --no-compile -c constraints.txt -e
# pip compiles on one core, and packages' own tests too; a file that does not compile is one that nothing here imports
COMPILE := $(BIN)/python -W ignore -m compileall -qq -j 0 -x '/tests?/' $(VENV)/lib || true
OPEN3D_LIBRARIES := libegl1 libgl1 libgomp1 libusb-1.0-0 libx11-6
MOCKED_DEVICES := umockdev gir1.2-umockdev-1.0 python3-gi
BROWSER := chromium fonts-dejavu-core
VIRTUAL_MACHINE := qemu-system-x86 busybox-static
SCREEN := xvfb mesa-vulkan-drivers libxkbcommon-x11-0
SLURM := slurm-wlm munge
BLOCK_REPLAY := user-mode-linux dmsetup e2fsprogs xfsprogs btrfs-progs
COUNTS := .cache/counts.jsonl
SECONDS := 60
DATA := $(TACPIPE_SAMPLE_DATA)
EVERY := 1
CALLS := 3
TARGETS :=
FAULTS :=
PAGED := tests/promises tests/stores $(patsubst %,tests/test_%.py,api cli dataset garbage keys labels lineage pages pipeline presence previous replacing run show splits store thousand transfer)
PYTEST := OMP_NUM_THREADS=1 $(BIN)/pytest -q -n auto --dist worksteal
COUNTED := TACPIPE_COUNTS=$(CURDIR)/$(COUNTS) $(PYTEST)
# thousands of small projects come and go: in memory, where there are 4 GB of it, no disk delays them
FAST := $(shell test "$$(df --output=avail /dev/shm 2> /dev/null | tail -n 1)" -gt 4000000 2> /dev/null && echo /dev/shm)
EXHAUSTIVE := $(if $(FAST),TMPDIR=$(FAST)) TACPIPE_TEST_CALLS=$(CALLS) $(COUNTED) -o tmp_path_retention_policy=failed --every $(EVERY)
export PYTHONDONTWRITEBYTECODE := # a command that finds its bytecode starts in a third of the time; tests start hundreds
PROPERTIES := $(wildcard $(addprefix tests/, test_hashing.py test_keys.py test_dataset.py sensors/test_framing.py \
    sensors/test_every_sensor.py signals/test_clocks.py))
OLD_ENOUGH := import sys; sys.exit(sys.version_info < (3, 11))

# Install Debian packages $(1), or say the one command where there are no rights.
define debian
if [ "$$(id -u)" = 0 ] && command -v apt-get > /dev/null; then \
    echo "Installing the Debian packages $(1)"; \
    apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $(1) > /dev/null; \
else \
    echo "The Debian packages $(1) are missing: run 'sudo apt-get install -y $(1)', then make again." >&2; exit 1; \
fi
endef

# Install what makes system calls fail, and begin the file of counts.
define exhaustive
if ! command -v strace > /dev/null; then \
    ($(call debian,strace)) || echo "Until then the tests that make system calls fail are skipped." >&2; \
fi; \
mkdir -p $(dir $(COUNTS)); : > $(COUNTS)
endef

.PHONY: help help-all demo rig-demo live-demo wheel docs pictures benchmark learning-curve touch-uncertainty unknown-materials test test-long test-rig test-ci test-loaded test-paged test-faults test-exports test-trackers test-viewer viewer-pictures test-install test-power test-slurm test-exits broken-data fuzz test-kernel check lint types bless bench clean

help: ## show the targets that people use
	@grep -E '^[a-z-]+:.* ## ' $(MAKEFILE_LIST) | sed -E 's/:.* ## /\t/' | expand -t 16

help-all: ## show all targets, those of maintainers too
	@grep -E '^[a-z-]+:.* #[#-] ' $(MAKEFILE_LIST) | sed -E 's/:.* #[#-] /\t/' | expand -t 20

demo: $(VENV)/.learn ## run the main job on simulated recordings, ending with demo/report.html
	@$(BIN)/tacpipe demo -o demo

wheel: $(VENV)/.python ## build a wheel into dist/, for computers without a clone
	@$(PIP) wheel --no-deps -w dist .

docs: $(VENV)/.docs ## build the documentation as a site into .cache/site
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo .cache/site/index.html

pictures: demo #- draw the pictures of the documentation, that of the front page from the demo's report
	@$(BIN)/python docs/pictures.py demo/report.html
	@$(BIN)/python docs/moving_picture.py .cache/slip

benchmark: $(VENV)/.dev #- measure every published set in DATA next to the numbers of its paper, in days; OPTIONS=--quick takes minutes
	@$(BIN)/python benchmarks/published.py $(DATA) $(OPTIONS)

learning-curve: $(VENV)/.dev #- measure what more recordings are worth to forward, on the dataset of segments DATA; OPTIONS="--draws 2"; minutes to hours
	@$(BIN)/python docs/learning_curve.py $(DATA) $(OPTIONS)

touch-uncertainty: $(VENV)/.dev #- measure quantiles of predicted touch on the published grasps in DATA; a table
	@$(BIN)/python docs/touch_uncertainty.py $(DATA)

unknown-materials: $(VENV)/.dev #- measure the answer unknown with materials left out, on the published slides in DATA; a table
	@$(BIN)/python docs/unknown_materials.py $(DATA)

rig-demo: $(VENV)/.dev ## replay simulated trials as the first paper's rig, record it live for 30 s, then the chain to a forecast
	@$(BIN)/tacpipe demo --rig rigs/first-paper.toml -o rig-demo

live-demo: $(VENV)/.dev ## replay simulated slips as the first paper's rig and predict them live for 60 s; a summary and live-demo/live.png
	@$(BIN)/python docs/live_demo.py live-demo rigs/first-paper.toml

test: $(VENV)/.dev ## run the tests that need neither real time nor minutes: some 5 minutes on 2 cores
	@$(PYTEST) -m "not faults and not long and not rig"

test-long: $(VENV)/.dev ## run the tests that take long: training, kills and crowds, DVC's chains, the docs' commands
	@$(PYTEST) -m "long and not faults"

language: $(VENV)/.dev #- print words, names and comments that plainer language may replace; it is advice
	@$(BIN)/python tests/language.py

test-rig: $(VENV)/.dev ## run the tests that emulate devices in real time
	@$(PYTEST) -m "rig and not faults"

test-ci: $(VENV)/.dev #- run the tests of all three in one go; FAULTS=2/10 adds a part of test-faults
	@$(if $(FAULTS),$(exhaustive))
	@$(COUNTED) $(if $(FAULTS),--faults $(FAULTS),-m "not faults")
	@$(if $(FAULTS),$(COUNTED) -n 0 --hypothesis-profile=faults --every $(FAULTS) $(PROPERTIES))
	@$(if $(FAULTS),$(BIN)/python -m tests.promises.counts $(COUNTS))

test-loaded: $(VENV)/.dev #- run those of `test` and `test-rig` while eight other processes keep the computer busy
	@if ! command -v stress-ng > /dev/null; then $(call debian,stress-ng); fi
	@stress-ng --cpu 8 --quiet & load=$$!; trap 'kill $$load' EXIT; $(PYTEST) -m "not faults and not long"

test-faults: $(VENV)/.dev #- try faults, kills and hostile input exhaustively, in some 25 minutes; EVERY=20 tries one of 20, EVERY=3/20 another one; CALLS=1 all of each stage
	@$(exhaustive)
	@$(EXHAUSTIVE) tests/promises
	@$(EXHAUSTIVE) --hypothesis-profile=faults $(PROPERTIES)
	@$(EXHAUSTIVE) -m faults --ignore=tests/promises $(PROPERTIES:%=--ignore=%)
	@$(BIN)/python -m tests.promises.counts $(COUNTS)

test-paged: $(VENV)/.dev #- run the tests of stores and datasets with every dataset of two recordings or more divided into pages
	@PYTHONPATH=tests/paged $(PYTEST) -m "not faults and not long and not rig and not inline" $(PAGED)

test-slurm: $(VENV)/.dev #- start Slurm on this computer, as root, and put the questions of all executors to its jobs
	@if ! command -v slurmctld > /dev/null; then $(call debian,$(SLURM)); fi
	@$(PYTEST) tests/executors -k slurm

test-exits: $(VENV)/.dev #- run 2,000 times `tacpipe show` and other commands that end after reading Parquet, and count exit codes
	@$(BIN)/python -m tests.promises.exits

fuzz: $(VENV)/.fuzz #- let atheris look for bytes that a reader stumbles over: make fuzz SECONDS=60 TARGETS="pcd sensor"
	@OMP_NUM_THREADS=1 $(BIN)/python -m fuzz --seconds $(SECONDS) $(TARGETS)

test-kernel: $(VENV)/.dev #- run the tests of HID on Debian's kernel in a virtual machine, which takes a minute
	@if ! command -v qemu-system-x86_64 > /dev/null || ! dpkg -s busybox-static > /dev/null 2>&1; then \
	    $(call debian,$(VIRTUAL_MACHINE)); \
	fi
	@OMP_NUM_THREADS=1 TACPIPE_TEST_KERNEL=1 $(BIN)/pytest -q -s tests/kernel

test-exports: $(VENV)/.dev #- have LeRobot's loader, datasets and mlcroissant open exports, in an environment of their own (0.5 GB)
	@if [ ! -e .cache/exports/bin/.made ]; then \
	    $(BIN)/python -m tests.exports.environment .cache/exports && touch .cache/exports/bin/.made; \
	fi
	@if ! command -v ffmpeg > /dev/null; then $(call debian,ffmpeg); fi
	@TACPIPE_EXPORTS_PYTHON=$(CURDIR)/.cache/exports/bin/python $(PYTEST) tests/exports

broken-data: $(VENV)/.dev #- compare how tools read inputs with one fault each, and write the table of the page
	@OMP_NUM_THREADS=1 $(BIN)/python -m tests.broken.table

test-viewer: $(VENV)/.dev #- have Rerun's own reader open what `tacpipe view` writes, in an environment of its own (0.5 GB)
	@if [ ! -e .cache/viewer/bin/.made ]; then \
	    $(BIN)/python -m tests.viewer.environment .cache/viewer && touch .cache/viewer/bin/.made; \
	fi
	@OMP_NUM_THREADS=1 .cache/viewer/bin/python -m pytest -q tests/viewer

viewer-pictures: $(VENV)/.dev #- take the pictures of the viewer in the documentation, under a virtual screen (Xvfb)
	@if [ ! -e .cache/viewer/bin/.made ]; then \
	    $(BIN)/python -m tests.viewer.environment .cache/viewer && touch .cache/viewer/bin/.made; \
	fi
	@if ! command -v Xvfb > /dev/null; then $(call debian,$(SCREEN)); fi
	@.cache/viewer/bin/python docs/viewer_pictures.py

test-trackers: $(VENV)/.dev #- have TensorBoard, an MLflow server and W&B read what --track gives them, in an environment of their own (1 GB)
	@if [ ! -e .cache/trackers/bin/.made ]; then \
	    $(BIN)/python -m tests.trackers.environment .cache/trackers && touch .cache/trackers/bin/.made; \
	fi
	@TACPIPE_TRACKERS_PYTHON=$(CURDIR)/.cache/trackers/bin/python $(PYTEST) tests/trackers

test-install: $(VENV)/.dev #- build the wheel and the sdist, install them with each extra into clean environments, and use them
	@$(BIN)/python -m tests.packaging.environments

test-power: $(VENV)/.dev #- replay a loss of power at each write on ext4, xfs and btrfs in User-mode Linux; EVERY=20 tries one of 20
	@if [ -n "$$($(BIN)/python -c 'from tests.power import machine; print(machine.lacking())')" ]; then \
	    $(call debian,$(BLOCK_REPLAY)); \
	fi
	@TACPIPE_TEST_POWER=$(EVERY) $(PYTEST) tests/power

check: $(VENV)/.dev ## lint and types, next to one another
	@$(MAKE) --no-print-directory --jobs=2 --output-sync lint types

lint: $(VENV)/.dev #- check style, and that imports follow the layers
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/lint-imports --no-logo

types: $(VENV)/.dev #- check types
	@$(BIN)/mypy

bless: $(VENV)/.dev #- pin the golden digests of stages whose version was raised
	@$(BIN)/python -m tests.golden_values

bench: $(VENV)/.dev #- measure CPU seconds, memory and bytes next to peers; writes benchmarks/results.md
	@$(BIN)/python benchmarks/run.py

clean: ## remove .venv, demo and caches; .tacpipe stays, because recordings lie there
	@rm -rf $(VENV) .cache demo rig-demo live-demo build dist *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	@find . -name __pycache__ -not -path './.tacpipe/*' -prune -exec rm -rf {} +

# A stamp in .venv says what is installed there, so a second call installs nothing.
$(VENV)/.python:
	@python=; for name in python3.11 python3; do \
	    if "$$name" -c '$(OLD_ENOUGH)' 2> /dev/null; then python=$$name; break; fi; \
	done; \
	if [ -z "$$python" ]; then \
	    echo "Python 3.11 or newer is missing: run 'sudo apt-get install -y python3 python3-venv', then make again." >&2; \
	    exit 1; \
	fi; \
	if ! "$$python" -c 'import ensurepip, venv' 2> /dev/null; then $(call debian,python3-venv); fi; \
	echo "Making $(VENV) with $$("$$python" --version)"; \
	"$$python" -m venv --clear $(VENV)
	@touch $@

$(VENV)/.learn: $(VENV)/.python pyproject.toml constraints.txt
	@echo "Installing tacpipe[learn] into $(VENV)"
	@$(INSTALL) '.[learn]'
	@$(COMPILE)
	@touch $@

$(VENV)/.dev: $(VENV)/.python pyproject.toml constraints.txt
	@echo "Installing tacpipe[all,dev] into $(VENV)"
	@$(INSTALL) '.[all,dev]'
	@$(COMPILE)
	@if ! $(BIN)/python -c 'import open3d' 2> /dev/null; then \
	    $(call debian,$(OPEN3D_LIBRARIES)); \
	    $(BIN)/python -c 'import open3d'; \
	fi
	@if ! command -v umockdev-wrapper > /dev/null; then \
	    ($(call debian,$(MOCKED_DEVICES))) || echo "Until then the tests that need a HID device are skipped." >&2; \
	fi
	@if ! command -v chromium > /dev/null; then \
	    ($(call debian,$(BROWSER))) || echo "Until then the tests that look at pages in a browser are skipped." >&2; \
	fi
	@touch $(VENV)/.learn $@

$(VENV)/.docs: $(VENV)/.dev
	@echo "Installing tacpipe[docs] into $(VENV)"
	@$(INSTALL) '.[docs]'
	@touch $@

$(VENV)/.fuzz: $(VENV)/.dev
	@echo "Installing tacpipe[fuzz] into $(VENV)"
	@$(INSTALL) '.[fuzz]'
	@touch $@
