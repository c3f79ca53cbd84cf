# make help lists what this file does. Every goal makes .venv first, once, with the versions in constraints.txt.

PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
DPC    := $(BIN)/dpc

# The demo learns real actions when MSRACTION names a folder of MSR-Action3D, synthetic gestures otherwise.
MSRACTION ?=
ifneq ($(strip $(MSRACTION)),)
DEMO       := demo/msraction3d
DEMO_INPUT := msraction3d "$(MSRACTION)"
else
DEMO       := demo/gestures
DEMO_INPUT := synthetic gestures
endif
DEMO_TRAIN ?= --preset tiny --timing uniform
BENCH_DATA ?= $(or $(MSRACTION),$(wildcard ../shared/data/msraction3d))

# Programs of tables read and write texts that hold letters such as ±, whatever the locale.
export PYTHONUTF8 := 1

.DELETE_ON_ERROR:
.DEFAULT_GOAL := help
.PHONY: help venv demo test bench fuzz kills soak lint clean table-4.1 table-4.2 table-4.3 table-4.4 table-4.5 table-4.6 table-5.1
.PHONY: table-5.2 figure-5.3
.PHONY: few-videos segments prior table-3.1 table-3.2 table-3.3 table-3.4 table-3.5 figure-3.5 figure-3.8 table-A.1 figure-A.4

help:
	@echo "make demo [MSRACTION=folder]  depth videos -> a trained Kinet -> a table; rigid parts; a 4D scene; results in demo/"
	@echo "make test                     lint, the examples in docstrings, the whole test suite"
	@echo "make lint                     ruff over everything: faults and format"
	@echo "make bench [MSRACTION=folder] speed of ours against the reference and against what one would take instead"
	@echo "make table-3.1 NVGESTURE=folder [MODELNET=folder]  ablations of Kinet; or MSRACTION=folder"
	@echo "make table-3.2 NVGESTURE=folder, table-3.3 SHREC17=folder, table-3.5 NTU60=folder  accuracy"
	@echo "make table-3.4 MSRACTION=folder accuracy on 4 to 24 frames, three seeds; over an hour on 2 cores"
	@echo "make figure-3.5 MSRACTION=folder four settings swept over ten folds; or NVGESTURE=folder; a day"
	@echo "make figure-3.8 MSRACTION=folder parameters, FLOPs, accuracy of three backbones (= table-A.1)"
	@echo "make figure-A.4 MSRACTION=folder what each class gains; docs/reproduce.md says more of all of these"
	@echo "make segments MSRACTION=folder actions found in long recordings; eight minutes"
	@echo "make few-videos MSRACTION=folder accuracy against videos a class, fine-tuned and not; two hours"
	@echo "make table-4.1 SAPIEN=folder  the switches of unsupervised training, six rows; hours"
	@echo "make table-4.2 SAPIEN=folder  rigid parts on categories never seen, all methods; an hour and a half"
	@echo "make table-4.3 MESHES=folder | OGC=folder  rigid parts of rooms, all methods"
	@echo "make table-4.4 KITTI_SF=folder, table-4.5 KITTI_DET=folder, table-4.6 SEMANTICKITTI=folder  objects of streets"
	@echo "make table-5.1 MESHES=folder | ARTEMIS=folder  4D scenes of one view, six rows and that of the thesis; hours"
	@echo "make table-5.2 MESHES=folder  4D scenes of animated meshes, rows (a) to (e); an hour"
	@echo "make figure-5.3 MESHES=folder the same clips, control points and weight of temporal preservation; an hour and a half"
	@echo "make prior MESHES=folder      the shape network, trained and shown from the sides; many hours"
	@echo "make fuzz [SEED=1 INPUTS=10000 MINUTES=20 ONLY=\"prepare depth\"]  damaged files, then odd options: none ends as a bug"
	@echo "make soak [MINUTES=60]        a long stream, 60,000 samples, 256 shards: speed, memory and open files stay as they are"
	@echo "make kills [KILLS=100]        kill -9 at random moments of ten commands: each must end as if nothing had happened"
	@echo "make clean                    remove .venv, demo/, fuzz/, soak/ and caches; results in table/ and prior/ stay"
	@echo "PYTHON=python3.12 make ...    uses another Python (3.10 to 3.13)"

venv: $(READY)

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' \
	    || { echo "make: $(PYTHON) is not Python 3.10 to 3.13; try PYTHON=python3.12 make $(MAKECMDGOALS)" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null \
	    || { echo "make: $(PYTHON) lacks the venv module; on Debian and Ubuntu: apt install python3-venv" >&2; exit 1; }
	$(PYTHON) -m venv --clear $(VENV)
	$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt -e '.[test]'
	$(BIN)/python -m compileall -qq -j 0 -x 'site-packages/.*/tests?/' $(VENV)/lib || true # as pip does, on all cores; a few files are templates
	@touch $@

demo: $(READY)
	mkdir -p $(DEMO)
	$(DPC) prepare $(DEMO_INPUT) -o $(DEMO)/clouds.h5
	$(DPC) info $(DEMO)/clouds.h5 --picture $(DEMO)/clouds.png
	$(DPC) classify train $(DEMO)/clouds.h5 -o $(DEMO)/model $(DEMO_TRAIN)
	$(DPC) classify predict $(DEMO)/clouds.h5 --model $(DEMO)/model -o $(DEMO)/scores.h5 --clips-per-video 3 --force
	$(DPC) evaluate classification $(DEMO)/scores.h5 --split test --picture $(DEMO)/confusion.png
	$(DPC) prepare synthetic articulated -o demo/objects.h5 --objects 11 --sequences-per-object 1 --force
	$(DPC) segment predict demo/objects.h5 -o demo/parts.h5 --picture demo/parts.png --turntable demo/parts.gif --force
	$(DPC) evaluate segmentation demo/parts.h5 --truth demo/objects.h5 --split all
	$(DPC) prepare synthetic animal -o demo/animal.h5 --seed 10 --size 128 --frames 16 --yaw 90 --no-travel --force
	$(DPC) generate4d fit demo/animal.h5 -o demo/scene.h5 --preset fast
	$(DPC) generate4d render demo/scene.h5 -o demo/scene.mp4 --picture demo/scene.png --force
	$(DPC) generate4d view demo/scene.h5 -o demo/scene.html --force
	$(DPC) evaluate video demo/scene.h5 --truth demo/animal.h5
	@echo "The 4D scene: open demo/scene.html in a browser, or demo/scene.mp4."
	@echo "The pictures are $(DEMO)/clouds.png, $(DEMO)/confusion.png, demo/parts.png, demo/parts.gif and demo/scene.png."

# What failed runs again, to show values: pytest's rewriting of all assertions takes each worker ten seconds.
TESTS := $(BIN)/python -m pytest -q -n 3 --dist loadfile --no-loadscope-reorder
test: lint
	$(TESTS) --assert=plain || { $(TESTS) --last-failed --last-failed-no-failures none; exit 1; }

# Chapter 3 and appendix A (docs/reproduce.md). Stopped, each goes on where it was; results in table/NUMBER/table.md.
# PRESET quick or thesis; SEEDS; BUDGET: words for `dpc classify train`, such as "--epochs 40 --batch 16"; CLIPS per video
# at prediction; PREPARE: words for `dpc prepare`. Table 3.4: the other lengths go on from the network of FROM frames (none:
# each on its own), by MORE, words for `dpc classify train`.
NVGESTURE ?=
SHREC17   ?=
NTU60     ?=
MODELNET  ?=
PRESET    ?= quick
SEEDS     ?= 0,1,2
FRAMES    ?= 4,8,12,16,24
FROM      ?= 16
FOLDS     ?= 10
FLOW      ?= icp
# needs-GOAL stops make where GOAL lacks its data. The last line reads it of each goal asked for, before .venv takes minutes.
needs      = $(if $(strip $($(1))),,$(error make $(goal) needs $(1)=folder, $(2)))
needs_either = $(if $(strip $(NVGESTURE)$(MSRACTION)),,$(error make $(goal) needs NVGESTURE=folder or MSRACTION=folder))
MSR_IS    := the folder of MSR-Action3D's depth videos
GLB_IS    := a folder with Cow.glb, Fox.glb, Trex.glb and Spider.glb below it
NV_IS     := the folder of NvGesture's lists and Video_data
EITHER     = $(if $(strip $(NVGESTURE)),nvgesture "$(NVGESTURE)",msraction3d "$(MSRACTION)")
PLAN       = --preset $(PRESET) --seeds "$(SEEDS)" $(if $(CLIPS),--clips $(CLIPS)) $(if $(PREPARE),--prepare="$(PREPARE)")
CHAIN      = --from "$(FROM)" $(if $(MORE),--more="$(MORE)")
TABLES    := $(BIN)/python -m dpcli.reproduce

needs-table-3.1 = $(call needs_either)
table-3.1: $(READY)
	$(TABLES).table_3_1 $(EITHER) table/3.1 $(if $(MODELNET),--modelnet "$(MODELNET)") \
	    $(if $(PRETRAIN),--pretrain="$(PRETRAIN)") $(PLAN) -- $(BUDGET)

needs-table-3.2 = $(call needs,NVGESTURE,$(NV_IS))
table-3.2: $(READY)
	$(TABLES).accuracy_tables 3.2 "$(NVGESTURE)" table/3.2 $(PLAN) -- $(BUDGET)

needs-table-3.3 = $(call needs,SHREC17,the folder of train_gestures.txt and gesture_1 ...)
table-3.3: $(READY)
	$(TABLES).accuracy_tables 3.3 "$(SHREC17)" table/3.3 $(PLAN) -- $(BUDGET)

needs-table-3.4 = $(call needs,MSRACTION,$(MSR_IS))
table-3.4: $(READY)
	$(TABLES).accuracy_tables 3.4 "$(MSRACTION)" table/3.4 --only "$(FRAMES)" $(CHAIN) $(PLAN) -- $(BUDGET)

needs-table-3.5 = $(call needs,NTU60,the folder of nturgb+d_depth_masked or of its ZIPs)
table-3.5: $(READY)
	$(TABLES).accuracy_tables 3.5 "$(NTU60)" table/3.5 $(PLAN) -- $(BUDGET)

# SWEEPS: "group_size=2,4 radius=0.25,0.5" replaces the values of these; "radius=" leaves one out. ONLY=0,1: these folds.
needs-figure-3.5 = $(call needs_either)
figure-3.5: $(READY)
	$(TABLES).figure_3_5 $(EITHER) table/figure-3.5 --preset $(PRESET) --folds $(FOLDS) --only "$(ONLY)" \
	    $(foreach sweep,$(SWEEPS),--sweep $(sweep)) $(if $(PREPARE),--prepare="$(PREPARE)") -- $(BUDGET)

# FLOW: icp, nearest, or a folder that `dpc segment flow` made. PROFILE=only: without data, without accuracies.
needs-figure-3.8 = $(if $(filter only,$(PROFILE)),,$(if $(MSRACTION),,$(error make $(goal) needs MSRACTION=folder, $(MSR_IS); or PROFILE=only)))
needs-table-A.1 = $(needs-figure-3.8)
figure-3.8 table-A.1: $(READY)
	$(TABLES).figure_3_8 "$(or $(MSRACTION),-)" table/figure-3.8 --flow "$(FLOW)" $(if $(BACKBONES),--backbones $(BACKBONES)) \
	    $(if $(filter only,$(PROFILE)),--profile-only) $(PLAN) -- $(BUDGET)

needs-figure-A.4 = $(call needs,MSRACTION,$(MSR_IS))
figure-A.4: $(READY)
	$(TABLES).accuracy_tables 3.4 "$(MSRACTION)" table/3.4 --only 16 $(PLAN) -- $(BUDGET)
	$(TABLES).figure_a_4 table/figure-A.4 table/3.4/$(PRESET)-16-seed*/scores.h5 \
	    --flow table/figure-3.8/pointnet2/$(PRESET)-two-streams-seed*.h5

# Table 4.2 of the thesis on three categories that training never sees; SAPIEN names a folder of PartNet-Mobility objects.
SAPIEN  ?=
T42     := table/4.2
HELD    := Box,Knife,Refrigerator
PARTS   := --split test --force
MADE_OF := --test-categories $(HELD) --fractions 1,0,0
T42_TRAIN ?= --validation 0.03 --epochs 6 --batch 4 --lr 0.0015 \
    --set motion_after=0.4 --set update_after=0.5 --set consensus_after=0.6

needs-table-4.2 = $(call needs,SAPIEN,a folder of CATEGORY/ID/mobility.urdf)
table-4.2: $(READY)
	mkdir -p $(T42)
	$(DPC) prepare sapien "$(SAPIEN)" -o $(T42)/train.h5 --pairs-per-object 16 --joint-step 0.6 --seed 1 $(MADE_OF)
	$(DPC) prepare sapien "$(SAPIEN)" -o $(T42)/test.h5 --pairs-per-object 4 --seed 0 $(MADE_OF)
	$(DPC) segment train $(T42)/train.h5 -o $(T42)/model $(T42_TRAIN)
	$(DPC) segment train $(T42)/train.h5 -o $(T42)/plain $(T42_TRAIN) --set group=trivial --set flows_of=$(T42)/model
	$(DPC) segment predict $(T42)/test.h5 -o $(T42)/ours.h5 $(PARTS) --model $(T42)/model --picture $(T42)/ours.png
	$(DPC) segment predict $(T42)/test.h5 -o $(T42)/without-equivariance.h5 $(PARTS) --model $(T42)/plain
	$(DPC) segment predict $(T42)/test.h5 -o $(T42)/one-part.h5 $(PARTS) --method ward --parts 1
	for method in dbscan ward ssc trajaffn; do \
	    $(DPC) segment predict $(T42)/test.h5 -o $(T42)/$$method.h5 $(PARTS) --method $$method || exit 1; done
	for name in ours without-equivariance one-part dbscan ward ssc trajaffn; do for protocol in dpc release; do \
	    echo "## $$name, protocol $$protocol"; \
	    $(DPC) evaluate segmentation $(T42)/$$name.h5 --truth $(T42)/test.h5 --split test --protocol $$protocol --markdown || exit 1; \
	done; done > $(T42)/table.md
	cat $(T42)/table.md

# Actions found in long recordings made of MSR-Action3D's test videos; SEGMENTS: words for the program.
needs-segments = $(call needs,MSRACTION,$(MSR_IS))
segments: $(READY)
	$(TABLES).segments "$(MSRACTION)" table/segments $(SEGMENTS)

# Fine-tuning on classes never seen; FEW: words for the program, such as "--videos 5,10 -- --preset tiny --timing uniform".
needs-few-videos = $(call needs,MSRACTION,$(MSR_IS))
few-videos: $(READY)
	mkdir -p table/few-videos
	$(DPC) prepare msraction3d "$(MSRACTION)" -o table/few-videos/clouds.h5 --points 1024
	$(TABLES).few_videos table/few-videos/clouds.h5 table/few-videos $(FEW)

# Table 4.1: the switches of training, one after the other, with the same budget. Stopped, it goes on where it was.
T41 := table/4.1
needs-table-4.1 = $(call needs,SAPIEN,a folder of CATEGORY/ID/mobility.urdf)
table-4.1: $(READY)
	mkdir -p $(T41)
	$(DPC) prepare sapien "$(SAPIEN)" -o $(T41)/train.h5 --pairs-per-object 16 --joint-step 0.6 --seed 1 $(MADE_OF)
	$(DPC) prepare sapien "$(SAPIEN)" -o $(T41)/test.h5 --pairs-per-object 4 --seed 0 $(MADE_OF)
	$(TABLES).table_4_1 $(T41)/train.h5 $(T41)/test.h5 $(T41) -- $(T42_TRAIN)

# Table 4.3 on new rooms of the models below MESHES, or on OGC-DR and OGC-DRSV in the folder OGC; T43: words for the program.
OGC ?=
needs-table-4.3 = $(if $(MESHES)$(OGC),,$(error make $(goal) needs MESHES=folder, models to furnish rooms with, or OGC=folder, with OGC-DR and OGC-DRSV in it))
table-4.3: $(READY)
	$(TABLES).table_4_3 table/4.3 $(if $(OGC),--ogc "$(OGC)",--meshes "$(MESHES)") $(T43)

# Tables 4.4 to 4.6, objects of KITTI's streets; T44, T45, T46: words for the program. Stopped, they go on where they were.
needs-table-4.4 = $(if $(KITTI_SF),,$(error make $(goal) needs KITTI_SF=folder, with training/disp_occ_0, flow_occ, instance, ... in it))
table-4.4: $(READY)
	$(TABLES).street_tables table/4.4 --kitti-sf "$(KITTI_SF)" $(T44)

needs-table-4.5 = $(if $(KITTI_DET),,$(error make $(goal) needs KITTI_DET=folder, with training/velodyne, label_2, calib in it))
table-4.5: $(READY)
	$(TABLES).street_tables table/4.5 --kitti-det "$(KITTI_DET)" $(T45)

needs-table-4.6 = $(call needs,SEMANTICKITTI,with dataset/sequences/00 ... 10 in it)
table-4.6: $(READY)
	$(TABLES).street_tables table/4.6 --semantickitti "$(SEMANTICKITTI)" $(T46)

# Table 5.1 on ARTEMIS' animals (ARTEMIS names their folder) or on animated meshes; T51: words for the program.
MESHES ?=
ARTEMIS ?=
needs-table-5.1 = $(if $(MESHES)$(ARTEMIS),,$(error make $(goal) needs MESHES=folder, a folder with the held-out models below it, or ARTEMIS=folder))
table-5.1: $(READY)
	$(TABLES).scenes.table_5_1 table/5.1 $(if $(ARTEMIS),--artemis "$(ARTEMIS)",--meshes "$(MESHES)") $(T51)

# Table 5.2 of the thesis on animated meshes; MESHES names a folder of .glb files; T52: words for the program. Stopped, it
# goes on where it was.
needs-table-5.2 = $(call needs,MESHES,$(GLB_IS))
table-5.2: $(READY)
	$(TABLES).scenes.table_5_2 "$(MESHES)" table/5.2 $(T52)

# Figure 5.3 of the thesis on the same clips: the number of control points, and the weight of temporal preservation.
needs-figure-5.3 = $(call needs,MESHES,$(GLB_IS))
figure-5.3: $(READY)
	$(TABLES).scenes.figure_5_3 "$(MESHES)" table/figure-5.3 $(T52)

# The shape network on models (.glb) anywhere below MESHES; PRIOR: words for `dpc generate4d train-prior`. Stopped, it goes on.
HELD_OUT := dpcli/reproduce/scenes/held_out_models.txt
PRIOR ?= --set amp=true
needs-prior = $(call needs,MESHES,a folder with the models of $(HELD_OUT) and many others below it)
prior: $(READY)
	$(DPC) generate4d train-prior "$(MESHES)" -o prior/run --held-out $(HELD_OUT) $(PRIOR)
	$(TABLES).scenes.prior_sides "$(MESHES)" prior --models prior/run

fuzz: $(READY)
	$(BIN)/python -m tests.fuzz.fuzz_files fuzz/files $(if $(SEED),--seed $(SEED)) $(if $(INPUTS),--inputs $(INPUTS)) \
	    $(if $(MINUTES),--minutes $(MINUTES)) --only "$(ONLY)"
	$(BIN)/python -m tests.fuzz.fuzz_options fuzz/options --only "$(ONLY)"

soak: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[bench]'
	$(BIN)/python -m tests.bench.soak soak $(if $(MINUTES),--minutes $(MINUTES))

KILLS ?= 100
SEED  ?= 1
kills: $(READY)
	$(BIN)/python -m tests.fuzz.fuzz_kills fuzz/kills --kills $(KILLS) --seed $(SEED) --only "$(ONLY)"

bench: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[bench]'
	$(BIN)/python -m tests.bench.bench_ops
	$(BIN)/python -m tests.bench.bench_splatting
	$(BIN)/python -m tests.bench.bench_video_metrics
	$(BIN)/python -m tests.bench.bench_part_metrics
	$(BIN)/python -m tests.bench.bench_segment
	$(BIN)/python -m tests.bench.bench_spread
	$(BIN)/python -m tests.bench.bench_clouds
	$(DPC) classify profile --preset thesis --steps
	$(if $(BENCH_DATA),$(BIN)/python -m tests.bench.bench_store $(BENCH_DATA))
	$(if $(BENCH_DATA),$(BIN)/python -m tests.bench.bench_prepare $(BENCH_DATA),@echo "bench_prepare needs MSRACTION=folder")

lint: $(READY)
	$(BIN)/python -m ruff check --quiet .
	$(BIN)/python -m ruff format --quiet --check . || { echo "make: some files are not formatted; ruff format . does it" >&2; exit 1; }

clean:
	rm -rf $(VENV) demo fuzz soak build dist *.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(foreach goal,$(MAKECMDGOALS),$(needs-$(goal)))
