# make figures: everything that the documents quote is measured, and put into them.
#
# One command makes each file of docs/figures. Files made since the code last changed are kept in build/figures, so `make figures`
# goes on where it was stopped, and `make figures FIGURES="accuracy demo"` makes some. A file whose data is missing is left as it is.
# `make -f tools/evaluation/figures.mk commands` prints the command of each.
# BIN: the programs of the environment. DATA: the evaluation data. RUN_E: a folder with e.cam, map.circles and images/ of run e of
# the data set, in which nothing is written; SHIPPED: all shipped rows of that run. left-out.json is written by hand: it says by which commands.

BIN ?= .venv/bin
DATA ?= ../shared/data
RUN_E ?= $(DATA)/dlr/e
SHIPPED ?= $(DATA)/dlr/map.circles
PYTHON := OPENBLAS_NUM_THREADS=1 $(BIN)/python
MADE := build/figures
CODE := $(shell git ls-files 'camera/*.py' 'detect/*.py' 'detect/*.npz' 'lut/*.py' 'redetect/*.py' 'tools/*.py' 'tools/*.mk' \
    'images/e/*' 'images/m/*' docs/figures/down.cam)

# The studies: half an hour on two busy cores, of which speed, fusion and markers-frames take six minutes each, poses four, tilt-tilted and
# markers more than two, association, markers-photographs and real-run one to two.
FIGURES ?= accuracy photographs buildings buildings-published buildings-report rendered-r1 rendered-r2 disturbed cameras \
    demo sight-r1 sight-r2 tutorial real-run tilt-of-discs tilt-demo tilt-tilted tilt-room tilt-down soft \
    markers markers-frames markers-photographs markers-timing poses fusion association association-rows association-demo \
    map-speed speed

accuracy = accuracy
photographs = photographs $(DATA)/discs
buildings = buildings $(DATA)/york
buildings-published = buildings $(DATA)/york --preset published
buildings-report = buildings $(DATA)/york --preset report
rendered-r1 = rendered $(DATA)/rendered/r1
rendered-r2 = rendered $(DATA)/rendered/r2
disturbed = disturbed
cameras = cameras
demo = programs 'detect circles images/e -o @/e.circles' 'detect compare images/e --detected @/e.circles --json @/circles.json' \
    'detect all images/e -o @/e' 'detect compare images/e --detected @/e/detected.circles --json @/all.json'
sight = programs 'detect all $(DATA)/rendered/$(1) -o @/$(1)' \
    'detect compare $(DATA)/rendered/$(1) --detected @/$(1)/detected.circles --reference $(DATA)/rendered/$(1)/truth.circles --json @/all.json'
sight-r1 = $(call sight,r1)
sight-r2 = $(call sight,r2)
tutorial = programs 'tools.evaluation tutorial-photographs @/mine' \
    'camera calibrate @/mine/boards --half --columns 9 --rows 6 --square-m 0.04 -o @/lens.cam' \
    'camera floor @/lens.cam @/mine/floor.png --columns 9 --rows 6 --square-m 0.12 --floor-origin 0 -1.3 --floor-yaw 180 -o @/my.cam' \
    'detect all images/e --camera @/my.cam -o @/drive' \
    'detect compare images/e --detected @/drive/detected.circles --camera @/my.cam --json @/compared.json'
real-run = real-run $(RUN_E)
ids = --ids-from $(RUN_E)/map.circles --calibration-px 0.3
tilt-of-discs = programs 'detect circles $(RUN_E) $(ids) -o @/own.circles' \
    'detect circles $(RUN_E) $(ids) --tilt-sigma-deg 0.6 -o @/free.circles' \
    'slam map @/free.circles --calibrate --camera $(RUN_E)/e.cam -o @/map' 'detect all $(RUN_E) -o @/run' \
    $(foreach tilt,frames.tilt tilt,'tools.evaluation tilt-of-discs @/own.circles @/run/detected.$(tilt) --camera $(RUN_E)/e.cam \
    --map @/map/map.csv --path @/map/path.csv --raised-m -0.014 --figures @/$(subst .,_,$(tilt)).json')
simulated = programs 'tools.simulator run @/$(1)' 'tools.evaluation tilt @/$(firstword $(1)) --figures @/tilt.json'
tilt-demo = tilt images/e
tilt-tilted = $(call simulated,tilted --frames 80 --seed 8 --discs 32 --lookalikes 16 --visits 0.8 \
    --style.step-m 0.25 --style.tilt-deg 0.5 --style.constant-tilt-deg 2.3 0 --jobs 2)
tilt-room = $(call simulated,room --frames 40 --seed 3 --discs 60 --lookalikes 15 --style.constant-tilt-deg 2.3 0 --jobs 2)
tilt-down = $(call simulated,down --camera docs/figures/down.cam --frames 24 --seed 11 --discs 16 --lookalikes 8 \
    --style.step-m 0.5 --style.tilt-deg 0.4) 'tools.evaluation tilt @/down --tilt-prior-deg 0.4 --figures @/prior.json'
soft = programs 'tools.simulator run @/soft --frames 24 --seed 6 --style.tilt-deg 0.5 --sensor.blur-px 6' \
    'detect lines @/soft -o @/wide.lines' 'detect compare @/soft --lines --detected @/wide.lines --json @/wide.json' \
    'detect lines @/soft -o @/narrow.lines --blurred-widths' \
    'detect compare @/soft --lines --detected @/narrow.lines --json @/narrow.json'
no-statistics = markers --statistics 0 --no-spot
markers = markers --statistics 200 --seed 5 --jobs 2
markers-frames = $(no-statistics) --frames 1500 --seed 44 --backgrounds $(DATA)/york/dev --jobs 2
markers-photographs = $(no-statistics) --photographs $(DATA)/york $(DATA)/discs --jobs 2
markers-timing = $(no-statistics) --timing 40 --seed 5
poses = programs 'tools.simulator marker-session @/session --session.steps 40 --session.samples 8 --errors.network-m .003 \
    --errors.network-deg .05 --errors.rig-m .002 --errors.rig-deg .2' \
    $(foreach camera,a b c d,'detect markers @/session/$(camera)') 'groundtruth poses @/session -o @/session/poses.csv' \
    'groundtruth score @/session/poses.csv @/session/truth.csv --json @/score.json'
fusion = fusion --seeds 20
association = association $(SHIPPED) --sigma-scale 1.4
association-rows = programs 'tools.simulator rows @/s1' 'tools.evaluation association @/s1 --figures @/table.json'
association-demo = association images/e --circles --lines
map-speed = map-speed $(SHIPPED)
speed = --photographs $(DATA)/discs --frames 80 1600 16000 --factors 1 2 3 5 --landmarks 0 10 30 --pictures 8 --rounds 5 --budget-s 1

command = $(if $(filter speed,$(1)),benchmark,evaluation) $($(1))
needs = $(firstword $(filter $(DATA)% $(RUN_E)% $(SHIPPED),$(subst ', ,$($*))))

# One after the other, even with -j: some measure times. What a study that fails has written is not kept.
.NOTPARALLEL:
.DELETE_ON_ERROR:
.PHONY: figures commands
figures: $(FIGURES:%=$(MADE)/%.json)
	$(PYTHON) -m tools.evaluation documents

commands:
	@:$(foreach name,$(FIGURES),$(info $(name): python -m tools.$(call command,$(name))))

$(MADE)/%.json: $(CODE)
	@mkdir -p $(MADE)
	@if test -e $(or $(needs),.); then echo "$*: $(subst ','\'',$(call command,$*))"; begin=$$(date +%s); \
	    $(PYTHON) -m tools.$(call command,$*) --figures $@ > $(MADE)/$*.log || { cat $(MADE)/$*.log; exit 1; }; \
	    cp $@ docs/figures/; echo "$*: $$(($$(date +%s) - begin)) s"; \
	else echo "$*: left as it is: there is no $(needs)"; fi
