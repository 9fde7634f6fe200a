"""Makes a copy of cubecl-wgpu call `record` (record.rs) for every kernel that it compiles. usage: patch.py FOLDER"""
import pathlib
import sys

folder = pathlib.Path(sys.argv[1])


def replace(name, old, new):
    text = (folder / name).read_text()
    assert text.count(old) == 1, f"{name}: expected {old!r} once, found {text.count(old)} times"
    (folder / name).write_text(text.replace(old, new))


replace("src/lib.rs", "mod device;\n", "mod device;\nmod record;\n")
replace(
    "src/compiler/base.rs",
    "        match self {\n            AutoCompiler::Wgsl(_) => {\n                CompiledKernel::compile(",
    "        crate::record::record(&*kernel);\n        match self {\n            AutoCompiler::Wgsl(_) => {\n                CompiledKernel::compile(",
)
replace(
    "Cargo.toml",
    '[dependencies.cubecl-cpp]\nversion = "0.11.3"\nfeatures = ["metal"]\noptional = true\ndefault-features = false\n',
    '[dependencies.cubecl-cpp]\nversion = "0.11.3"\nfeatures = ["metal", "cuda", "std"]\ndefault-features = false\n',
)
replace(
    "Cargo.toml",
    '[dependencies.cubecl-spirv]\nversion = "0.11.3"\noptional = true\ndefault-features = false\n',
    '[dependencies.cubecl-spirv]\nversion = "0.11.3"\nfeatures = ["std"]\ndefault-features = false\n',
)
# Both are there always: what asked for them as options asks for less.
text = (folder / "Cargo.toml").read_text()
text = text.replace('cubecl-cpp?/', 'cubecl-cpp/').replace('cubecl-spirv?/', 'cubecl-spirv/').replace('    "cubecl-spirv",\n', "")
(folder / "Cargo.toml").write_text(text)
