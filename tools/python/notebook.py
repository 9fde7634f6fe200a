"""Runs the code cells of notebooks in order, each notebook in its folder, without Jupyter. What cells show is passed over; what they print is not.

    python tools/python/notebook.py examples/notebook/compare.ipynb
"""

import json
import linecache
import os
import pathlib
import sys
import time


def run(path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    if notebook.get("nbformat") != 4:
        sys.exit(f"{path}: nbformat: expected 4, found {notebook.get('nbformat')}")
    code = [(i, cell) for i, cell in enumerate(notebook["cells"]) if cell["cell_type"] == "code"]
    stored = [i for i, cell in code if cell["outputs"] or cell["execution_count"] is not None]
    if stored:
        sys.exit(f"{path}: cells {stored}: expected no stored outputs")
    os.chdir(path.parent)
    names = {"__name__": "__main__"}
    for i, cell in code:
        source, file = "".join(cell["source"]), f"{path.name}, cell {i}"
        # For tracebacks.
        linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)
        exec(compile(source, file, "exec"), names)


for name in sys.argv[1:]:
    begin = time.monotonic()
    run(pathlib.Path(name).resolve())
    print(f"{name}: {time.monotonic() - begin:.1f} s")
