"""Runs the tests that launch kernels. usage: run_tests.py BUILD, what `cargo test --no-run --message-format=json` printed."""
import json
import pathlib
import subprocess
import sys

wanted = {"freerange_raster", "freerange_model", "gpu"}
ran = set()
for line in pathlib.Path(sys.argv[1]).read_text().splitlines():
    message = json.loads(line)
    if message.get("executable") and message["target"]["name"] in wanted:
        ran.add(message["target"]["name"])
        subprocess.run([message["executable"]], cwd=pathlib.Path(message["manifest_path"]).parent, check=True)
assert ran == wanted, f"expected tests of {sorted(wanted)}, found {sorted(ran)}"
