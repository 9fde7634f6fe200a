#!/usr/bin/env bash
# Trains and evaluates the rows of the paper's tables (docs/results/paper-tables.md), in their order, and writes the tables.
#
#   tools/tables.sh BINARY PLACE [ROW...]
#
# BINARY is a release build of freerange with the feature `networks`. PLACE gets objects, runs and evaluations: a folder
# outside of the checkout, with 4 GB to spare. Whatever is there already is continued, to the bit as if never stopped: run
# the same command again after a kill. Without ROW all of them, in the order of the tables. After each row what the tables
# are made of goes to docs/results/paper-tables/ and the tables to docs/results/paper-tables/tables.md. A row that has no
# evaluation in PLACE is the one that docs/results/paper-tables/ has, if any. An evaluation that has a report but not its
# settings, such as a copy of a kept one, begins again. Exit status 1: the tables could not be written after some row.
#
# FREERANGE_SHARED names the folder of the 21 objects (../shared); without it they are left out, with a line that says so.
# WEIGHTS names the folder of LPIPS's weights (tools/lpips_weights.py makes it); without it LPIPS and the Frechet distance
# are reported as not computed.
# PART=4 trains every row on a quarter of the samples (its steps, warmup and the window of the averaged weights);
# OBJECTS and GENERATED are the numbers of objects to train on and to evaluate. What was chosen stands in the tables.
# On two idle cores of an AMD EPYC with AVX-512 BF16 the objects take 45 minutes, a row about as long, and its evaluation
# half of that (estimated).
set -euo pipefail
[ $# -ge 2 ] || { sed -n '2,/^set/p' "$0" | sed '$d'; exit 2; }
binary=$(realpath "$1") place=$(realpath -m "$2")
shift 2
cd "$(dirname "$0")/.."
rows=("$@")
[ ${#rows[@]} -gt 0 ] || rows=(full full_seed2 no_flow_matching no_rendering no_curriculum no_patching_half no_patching
  random_patches no_gradient_channels pixel_aligned voxel_aligned test_time tree_coupling pipeline)
objects=${OBJECTS:-3072} generated=${GENERATED:-100} part=${PART:-1}
shared=${FREERANGE_SHARED:-../shared}

kept=docs/results/paper-tables failed=0

mkdir -p "$place/rows" "$place/runs" "$kept"
mkdir -p "$place/configs/tables" && cp configs/tables/*.toml "$place/configs/tables/"
if [ "$part" != 1 ]; then
  python3 - "$part" "$place"/configs/tables/*.toml <<'PYTHON'
import re, sys
part = float(sys.argv[1])
shorter = lambda m: m[1] + str(max(1, round(int(m[2]) / part)))
for path in sys.argv[2:]:
    text = open(path).read()
    text = re.sub(r"\b((?:steps|warmup) = )(\d{3,})", shorter, text)
    text = re.sub(r"(?m)^ema = (.*)", lambda m: f"ema = {1 - part * (1 - float(m[1])):.6g}", text)
    open(path, "w").write(text)
PYTHON
fi
echo "== objects"
"$binary" data generate --objects "$objects" --first-seed 41000000 --gaussians fit --depths 7,8,9,10 \
  -o "$place/shards/tables" --config configs/tables/full.toml

# evaluate CHECKPOINT FOLDER SOURCE OPTION...: without CHECKPOINT the shipped pipeline. SOURCE is a number of generated objects, or `objects`, the 21.
evaluate() {
  local checkpoint=$1 folder=$2 source=$3 from to
  shift 3
  if [ "$source" = objects ]; then
    if [ ! -d "$shared/views" ]; then
      echo "== LEFT OUT: the 21 objects ($shared/views is not there)"
      return
    fi
    to=$folder/objects from=(--scenes "$shared/views")
  else
    to=$folder/generated from=(--generated "$source" --generated-size 256)
  fi
  if [ -f "$to/report.json" ] && [ ! -f "$to/settings.json" ]; then
    echo "== again: $to has a report without settings"
    rm -r "$to"
  fi
  [ -z "${WEIGHTS:-}" ] || from+=(--weights "$WEIGHTS")
  [ -z "$checkpoint" ] || from+=(--checkpoint "$checkpoint")
  "$binary" eval --pictures none --precision f32 "${from[@]}" -o "$to" "$@"
}

# tables ROW: the tables so far, of PLACE/tables: links to the rows of PLACE, and to kept ones where PLACE has none.
tables() {
  local all=$place/tables row
  rm -rf "$all"
  mkdir "$all"
  for row in "$kept"/*/ "$place"/rows/*/; do
    if compgen -G "$row*/report.json" >/dev/null; then ln -sfn "$(realpath "$row")" "$all/$(basename "$row")"; fi
  done
  if [ -f "$kept/claims.json" ]; then ln -s "$PWD/$kept/claims.json" "$all/"; fi
  if ! "$binary" eval paper-tables "$all" --keep "$kept" -o "$kept/tables.md"; then
    echo "== FAILED: the tables after $1"
    failed=1
  fi
}

# Full's checkpoint at other settings, on half of the objects: differences are paired.
test_time() {
  local out=$place/rows/full checkpoint=$place/runs/full/checkpoint.safetensors half=$(((generated + 1) / 2))
  for source in "$half" objects; do
    evaluate "$checkpoint" "$out/no-cfg" "$source" --metrics psnr,ssim --set propose.flow.cfg_scale=1
    evaluate "$checkpoint" "$out/no-photometric" "$source" --metrics psnr,ssim --set propose.flow.lambda_pg=0
  done
  for inputs in 2 6 9; do # the 21 have at most seven views to choose from
    evaluate "$checkpoint" "$out/inputs-$inputs" "$half" --metrics psnr,ssim --views full --inputs "$inputs"
  done
  # A mean is smooth, a sample is sharp.
  evaluate "$checkpoint" "$out/four-samples" "$half" --metrics psnr,frechet-vgg --views partial --samples 4
}

for row in "${rows[@]}"; do
  echo "== $row"
  if [ "$row" = test_time ]; then
    test_time
    tables "$row"
    continue
  fi
  run=$place/runs/$row out=$place/rows/$row checkpoint=$place/runs/$row/checkpoint.safetensors
  mkdir -p "$out"
  if [ "$row" = pipeline ]; then
    checkpoint=
  else
    "$binary" train "$place/configs/tables/$row.toml" -o "$run" --save-every 250
    cp "$run/log.jsonl" "$out/"
    "$binary" model info "$checkpoint" --json >"$out/model.json"
  fi
  metrics=psnr,ssim,lpips-alex
  case $row in full | no_flow_matching | pixel_aligned | voxel_aligned) metrics+=,lpips-vgg,frechet-vgg ;; esac
  for source in "$generated" objects; do
    evaluate "$checkpoint" "$out" "$source" --metrics "$metrics"
  done
  tables "$row"
done
exit "$failed"
