"""Trains a tiny model under an MPI launcher in many ways and compares what comes of it: see run.sh.

    python3 check.py PROGRAM FOLDER KILLS LAUNCHER...
"""

import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

# Four virtual ranks; two stages that differ in batch, depth and parts; objects that come and go; validation.
CONFIG = """
seed = 5
model = { image_size = 16, hidden = 16, blocks = 1, heads = 2, registers = 2, gaussians_per_token = 4, time_features = 8, encoder = { kind = "patch", patch_size = 8, channels = 4 } }
loss = { held_views = 1, input_views = [2, 2], render_size = 16, gradient_size = 16 }
validation = { every = 10, objects = 3 }
stage = [
    { depth = 3, image_size = 16, batch = 8, micro_batch = 1, steps = 9 },
    { depth = 4, image_size = 16, batch = 4, steps = %d },
]

[sample]
steps = 1
cfg_scale = 1.0
gradient_size = 16

[data]
virtual_ranks = 4
window = 12
fresh = 4
workers = 1
statistics_objects = 2

[data.object]
views = 4
samples_per_axis = 1

[data.object.cameras]
resolution = 16

[data.object.surface]
points = 64
"""
STEPS, SAVE_EVERY = 20, 20
TOLERANCE = 1e-5

program, place, kills = Path(sys.argv[1]).resolve(), Path(sys.argv[2]), int(sys.argv[3])
launcher = sys.argv[4:]
place.mkdir(parents=True)
# One thread per rank: this checks what comes out, not how fast.
environment = dict(os.environ, RAYON_NUM_THREADS="1")


def command(config, run, ranks, *options):
    train = [program, "train", config, "-o", run, "--save-every", str(SAVE_EVERY), *options]
    return [*launcher, "-n", str(ranks), *train] if ranks else train


def train(config, run, ranks, *options):
    done = subprocess.run(command(config, run, ranks, *options), capture_output=True, text=True, env=environment, timeout=300)
    assert done.returncode == 0, (done.returncode, done.stdout, done.stderr)


def log(run):
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    return [line for line in lines if "loss" in line], [line for line in lines if "validation" in line]


def weights(run):
    """A checksum of the averaged weights; the header before them tells how long training took."""
    data = (run / "checkpoint.safetensors").read_bytes()
    return hashlib.sha256(data[8 + int.from_bytes(data[:8], "little") :]).hexdigest()


def worst(run, expected):
    """The largest relative difference of losses and norms from another run's."""
    found, expected = log(run)[0], log(expected)[0]
    assert [line["step"] for line in found] == [line["step"] for line in expected], (len(found), len(expected))
    names = ["loss", "flow", "seen", "held", "gradient_norm"]
    pairs = [(a[name], b[name]) for a, b in zip(found, expected) for name in names]
    return max(abs(a - b) / max(abs(b), 1e-3) for a, b in pairs)


def saved(run):
    return max((int(p.name[6:]) for p in run.glob("state-[0-9]*")), default=0)


def say(what, value):
    print(f"{what}: {value}", flush=True)


def lives(pid):
    """A process that has ended but was not waited for yet is dead, too."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def ranks_of(run):
    """Processes that train in this folder, apart from the launcher."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            arguments = (folder / "cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        if arguments and Path(os.fsdecode(arguments[0])).name == program.name and os.fsencode(run) in arguments:
            if lives(folder.name):
                found.append(int(folder.name))
    return found


short = place / "short.toml"
short.write_text(CONFIG % (STEPS - 9))
alone = place / "alone"
train(short, alone, 0)
for ranks in [1, 2, 4]:
    run = place / f"ranks-{ranks}"
    train(short, run, ranks)  # weights are compared between ranks at each state
    difference = worst(run, alone)
    say(f"{ranks} ranks, {STEPS} steps, largest relative difference of losses and norms", f"{difference:.1e}")
    assert difference <= TOLERANCE
    for a, b in zip(log(run)[1], log(alone)[1], strict=True):
        assert abs(a["validation"]["psnr"] - b["validation"]["psnr"]) < 1e-3, (a, b)

# One rank, then two, then one, then four. No time at all is one step.
run = place / "changing"
for ranks in [1, 1, 1, 2, 2, 2, 1, 1, 4, 4, 2]:
    train(short, run, ranks, "--minutes", "0")
train(short, run, 1)
difference = worst(run, alone)
say("1, 2, 1, 4, 2 and 1 ranks in turn, largest relative difference", f"{difference:.1e}")
assert difference <= TOLERANCE

# A number of ranks that does not divide the virtual ranks, and another program.
done = subprocess.run(command(short, place / "three", 3), capture_output=True, text=True, env=environment, timeout=60)
assert "data.virtual_ranks: expected a multiple of the number of ranks, 3, found 4" in done.stderr, done.stderr
assert done.returncode == 2 and done.stderr.count("data.virtual_ranks") == 1, (done.returncode, done.stderr)

# Evaluation and many scenes: the same of each object, whoever measured it, and one report.
objects = ["eval", "--generated", "3", "--generated-size", "32", "--pictures", "none", "--iterations", "10"]
objects += ["--checkpoint", alone / "checkpoint.safetensors"]
bowl = Path(__file__).resolve().parents[2] / "examples" / "bowl"
names = ["first", "second", "third"]
for name in names:
    shutil.copytree(bowl, place / "scenes" / name)
(place / "scenes.txt").write_text("".join(f"scenes/{name}\n" for name in [*names[:2], "missing", names[2]]))
scenes = ["reconstruct", "--list", place / "scenes.txt", "--iterations", "10"]
scenes += ["--checkpoint", alone / "checkpoint.safetensors"]


def shared(arguments, output, ranks, code):
    """What a command that shares a list leaves, under the launcher or without it."""
    begin = [*launcher, "-n", str(ranks)] if ranks else []
    whole = [*begin, program, *arguments, "-o", output]
    done = subprocess.run(whole, capture_output=True, text=True, env=environment, timeout=300)
    assert done.returncode == code, (ranks, done.returncode, done.stdout, done.stderr)
    return done


def measured(output):
    """Each object's numbers, as its own file and as the report have them."""
    files = sorted((output / "objects").glob("*.json"))
    records = [json.loads(file.read_text()) for file in files]
    # Seconds and memory are what differs.
    kept = ["metrics", "inputs", "validation_sha256", "samples"]
    report = json.loads((output / "report.json").read_text())
    return [(r["case"], [r["outcome"][k] for k in kept]) for r in records], [g["metrics"] for g in report["groups"]]


shared(objects, place / "eval-0", 0, 0)
shared(scenes, place / "scenes-0", 0, 2)
made = [(place / "scenes-0" / name / "gaussians.ply").read_bytes() for name in names]
for ranks in [1, 2, 4]:
    output = place / f"eval-{ranks}"
    done = shared(objects, output, ranks, 0)
    assert measured(output) == measured(place / "eval-0"), ranks
    assert len(measured(output)[0]) == 6 and done.stdout.count("report.html") == 1, done.stdout
    # One of the four scenes is not there: it is named once, and the rest are made.
    output = place / f"scenes-{ranks}"
    done = shared(scenes, output, ranks, 2)
    rows = json.loads((output / "scenes.json").read_text())
    assert [row["scene"] for row in rows] == [*names[:2], "missing", names[2]], rows
    assert [bool(row.get("error")) for row in rows] == [False, False, True, False], rows
    assert [(output / name / "gaussians.ply").read_bytes() for name in names] == made, ranks
    # Again: nothing is left to do but to say what is there, and what is missing.
    again = shared(scenes, output, ranks, 2)
    assert "1 of 4 scenes failed: missing" in again.stderr, again.stderr
say("3 objects evaluated and 3 scenes made by 1, 2 and 4 ranks", "as by one process, to the bit")

# Kills.
long = place / "long.toml"
long.write_text(CONFIG % (50 + 40 * kills))
whole = place / "whole"
train(long, whole, 2)
run = place / "killed"
random.seed(7)
slowest = 0.0
for kill in range(kills):
    before = saved(run)
    job = subprocess.Popen(command(long, run, 2), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment)
    # At any moment after the next state, while it steps, measures or saves.
    until = time.monotonic() + 120
    while saved(run) <= before:
        assert job.poll() is None and time.monotonic() < until, "it makes no progress"
        time.sleep(0.002)
    time.sleep(random.uniform(0, 0.3))
    ranks = ranks_of(run)
    assert len(ranks) == 2, ranks
    os.kill(random.choice(ranks), signal.SIGKILL)
    begin = time.monotonic()
    code = job.wait(timeout=60)
    while any(lives(rank) for rank in ranks):
        assert time.monotonic() < begin + 60, "a rank goes on alone"
        time.sleep(0.01)
    seconds = time.monotonic() - begin
    slowest = max(slowest, seconds)
    assert code != 0 and seconds < 10, (code, seconds)
train(long, run, 2)
say(f"{kills} kills of a random rank, slowest end", f"{slowest:.2f} s")
assert weights(run) == weights(whole), "other weights"
say("weights of the killed run and of one never killed", "the same to the bit")

# One rank is asked to end: all save after the same step, and the job goes on to the same weights.
run = place / "asked"
job = subprocess.Popen(command(long, run, 2), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment)
until = time.monotonic() + 120
while saved(run) == 0:
    assert job.poll() is None and time.monotonic() < until, "it makes no progress"
    time.sleep(0.002)
os.kill(random.choice(ranks_of(run)), signal.SIGTERM)
text = job.communicate(timeout=60)[0].decode()
assert job.returncode == 0 and text.count("asked to end") == 1, (job.returncode, text)
assert f"{saved(run)} of " in text, (saved(run), text)
train(long, run, 2)
assert weights(run) == weights(whole), "other weights"
say("weights of the run of which one rank was asked to end", "the same to the bit")

# Launchers ask the others to end when one has died, and wait: a rank that waits for the dead one must not.
run = place / "alone-and-asked"
job = subprocess.Popen(command(long, run, 2), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment)
while saved(run) == 0:
    assert job.poll() is None, "it makes no progress"
    time.sleep(0.002)
first, second = ranks_of(run)
os.kill(second, signal.SIGTERM)
os.kill(first, signal.SIGKILL)
begin = time.monotonic()
job.communicate(timeout=60)
while lives(second):
    assert time.monotonic() < begin + 10, "a rank waits for a dead one"
    time.sleep(0.01)
say("one rank killed and the other asked, both ended after", f"{time.monotonic() - begin:.2f} s")
