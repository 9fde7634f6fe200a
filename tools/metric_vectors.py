#!/usr/bin/env python3
"""Reference vectors for the metrics that need a network: tests/golden/metrics/networks.

    python -m venv venv && venv/bin/pip install torch torchvision numpy scipy safetensors pillow pytorch-fid
    venv/bin/pip install --no-deps dreamsim
    venv/bin/python tools/metric_vectors.py tests/golden/metrics/networks

The networks are the packages' own (pytorch-fid's Inception-v3, DreamSim's vision transformer), in double precision,
with made-up weights: published ones are large, and what is verified is the computation. Inception's weights follow a
rule that the tests repeat (`uniform` below, by tensor name); DreamSim's are small files in the published formats.
Pillow changed the order of its two resizing passes in version 13 for some shapes; the vectors have the classic order
(horizontal first), which `resize` below repeats and which is checked against Pillow."""

import importlib.util
import json
import pathlib
import sys

import numpy as np
import torch
from PIL import Image
from safetensors.numpy import save_file

MASK = (1 << 64) - 1


def uniform(name, shape, low, high):
    """Numbers in low..high that depend on the name alone: splitmix64 from the name's FNV-1a hash, 24 bits each."""
    seed = 0xCBF29CE484222325
    for byte in name.encode():
        seed = ((seed ^ byte) * 0x100000001B3) & MASK
    n = int(np.prod(shape))
    with np.errstate(over="ignore"):
        z = np.uint64(seed) + (np.arange(n, dtype=np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z ^= z >> np.uint64(31)
    u = (z >> np.uint64(40)).astype(np.float32) / np.float32(1 << 24)
    return (np.float32(low) + u * np.float32(high - low)).reshape(shape)


def picture(name, width, height):
    """An 8-bit picture with smooth parts, edges and some noise."""
    a = uniform(name, (16,), -1, 1)
    y, x = np.mgrid[0:height, 0:width] / max(width, height)
    planes = [np.sin(9 * (a[c] * x + a[c + 3] * y) + 5 * a[c + 6]) * 0.5 + 0.5 for c in range(3)]
    image = np.stack(planes, -1)
    image[(x - 0.4) ** 2 + (y - 0.5) ** 2 < 0.06] = np.abs(a[9:12])
    image += uniform(name + "/noise", image.shape, -0.08, 0.08)
    return (np.clip(image, 0, 1) * 255).round().astype(np.uint8)


def taps(size, out):
    """Pillow's bicubic weights as fixed-point numbers: for each output pixel the first input pixel and the weights."""
    scale = size / out
    stretch = max(scale, 1.0)
    result = []
    for i in range(out):
        centre = (i + 0.5) * scale
        first, end = max(0, int(centre - 2 * stretch + 0.5)), min(size, int(centre + 2 * stretch + 0.5))
        d = np.abs((np.arange(first, end) - centre + 0.5) / stretch)
        w = np.where(d < 1, 1.5 * d**3 - 2.5 * d**2 + 1, np.where(d < 2, -0.5 * d**3 + 2.5 * d**2 - 4 * d + 2, 0))
        result.append((first, np.trunc(w / w.sum() * (1 << 22) + np.copysign(0.5, w)).astype(np.int64)))
    return result


def one_pass(image, out):
    """Along the first axis."""
    if out == image.shape[0]:
        return image
    rows = [np.tensordot(w, image[f : f + len(w)].astype(np.int64), 1) for f, w in taps(image.shape[0], out)]
    return np.clip((np.stack(rows) + (1 << 21)) >> 22, 0, 255).astype(np.uint8)


def resize(image, width, height, vertical_first=False):
    turned = lambda f, x: f(x.transpose(1, 0, 2)).transpose(1, 0, 2)
    if vertical_first:
        return turned(lambda x: one_pass(x, width), one_pass(image, height))
    return one_pass(turned(lambda x: one_pass(x, width), image), height)


def resized_like_pillow(image, width, height):
    ours = resize(image, width, height)
    pillow = np.asarray(Image.fromarray(image).resize((width, height), Image.BICUBIC))
    vertical = resize(image, width, height, vertical_first=True)
    assert (pillow == ours).all() or (pillow == vertical).all(), "Pillow resizes otherwise"
    return ours


def resizing(folder):
    tensors = {}
    for name, size, to in [("down", (61, 47), (32, 32)), ("up", (20, 23), (50, 31)), ("wide", (90, 17), (24, 40))]:
        image = picture(f"resize/{name}", *size)
        tensors[f"in/{name}"] = image
        tensors[f"out/{name}"] = np.ascontiguousarray(resized_like_pillow(image, *to))
    save_file(tensors, folder / "resize.safetensors")


def inception(folder):
    import pytorch_fid.inception as fid

    def weights(model):
        state = {}
        for key, value in model.state_dict().items():
            shape = tuple(value.shape)
            if key.endswith("num_batches_tracked"):
                state[key] = value
                continue
            if key.endswith("running_var"):
                bounds = (0.5, 1.5)
            elif key.endswith("bn.weight"):
                bounds = (0.8, 1.2)
            elif len(shape) == 4:
                fan_in = shape[1] * shape[2] * shape[3]
                bounds = (-float(np.sqrt(6 / fan_in)), float(np.sqrt(6 / fan_in)))
            else:
                bounds = (-0.1, 0.1)
            state[key] = torch.from_numpy(uniform(key, shape, *bounds))
        return state

    class Fill:
        """Stands in for the published file: the package loads whatever this returns."""

    original = torch.nn.Module.load_state_dict
    fid.load_state_dict_from_url = lambda *_, **__: Fill
    torch.nn.Module.load_state_dict = lambda m, s, *a, **k: original(m, weights(m) if s is Fill else s, *a, **k)
    try:
        model = fid.InceptionV3([3]).double().eval()
    finally:
        torch.nn.Module.load_state_dict = original
    def features(image):
        with torch.no_grad():
            return model(torch.from_numpy(image).permute(2, 0, 1)[None].double() / 255)[0].reshape(-1).numpy()

    small = [picture(f"inception/{i}", 64, 48) for i in range(2)]
    # Larger than the network's input: the test repeats the first picture in the same way.
    large = np.ascontiguousarray(np.tile(small[0], (7, 5, 1))[:310])
    tensors = {"in/image0": small[0], "in/image1": small[1]}
    for name, image in [("image0", small[0]), ("image1", small[1]), ("tiled", large)]:
        tensors[f"out/{name}"] = features(image).astype(np.float32)
    save_file(tensors, folder / "inception.safetensors")


def transformer_module():
    """DreamSim's `vision_transformer.py`, without the rest of the package and what that needs."""
    package = pathlib.Path(importlib.util.find_spec("dreamsim").submodule_search_locations[0])
    spec = importlib.util.spec_from_file_location("vit", package / "feature_extraction" / "vision_transformer.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class QuickGelu(torch.nn.Module):
    def forward(self, x):
        return x * torch.sigmoid(1.702 * x)


class LowRank(torch.nn.Module):
    """A linear layer with its adapter beside it, not merged."""

    def __init__(self, base, a, b, scale):
        super().__init__()
        self.base, self.a, self.b, self.scale = base, a.double(), b.double(), scale

    def forward(self, x):
        return self.base(x) + self.scale * (x @ self.a.T) @ self.b.T


def dreamsim(folder):
    vit = transformer_module()
    width, depth, heads, patch, side, projected, rank, alpha = 16, 2, 2, 8, 32, 12, 4, 6.0
    imagenet = ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225])
    clip = ([0.48145466, 0.4578275, 0.40821073], [0.26862954, 0.26130258, 0.27577711])
    branches, adapter = [], {}
    for i, kind in enumerate(["dino", "clip", "open_clip"]):
        model = vit.VisionTransformer(
            img_size=[side], patch_size=patch, embed_dim=width, depth=depth, num_heads=heads, mlp_ratio=4, qkv_bias=True
        )
        if kind != "dino":
            model.pos_drop = torch.nn.LayerNorm(width)
        state = {}
        for key, value in model.state_dict().items():
            base = 1.0 if "norm" in key and key.endswith("weight") or key == "pos_drop.weight" else 0.0
            bound = 0.2 if base else 0.6 if value.dim() < 2 or "embed" in key or "token" in key else 0.45
            state[key] = torch.from_numpy(uniform(f"{kind}/{key}", tuple(value.shape), base - bound, base + bound))
        model.load_state_dict(state)
        model = model.double().eval()
        epsilon = 1e-6 if kind == "dino" else 1e-5
        for module in model.modules():
            if isinstance(module, torch.nn.LayerNorm):
                module.eps = epsilon
        for b, block in enumerate(model.blocks):
            name = f"base_model.model.extractor_list.{i}.model.blocks.{b}.attn.qkv"
            low = [torch.from_numpy(uniform(f"{name}.{k}", s, -0.5, 0.5)) for k, s in [("A", (rank, width)), ("B", (3 * width, rank))]]
            adapter[f"{name}.lora_A.weight"], adapter[f"{name}.lora_B.weight"] = low
            block.attn.qkv = LowRank(block.attn.qkv, *low, alpha / rank)
            if kind == "clip":
                block.mlp.act = QuickGelu()
        projection = torch.from_numpy(uniform(f"{kind}/proj", (width, projected), -0.5, 0.5))
        if kind == "dino":
            torch.save(state, folder / "dino.pth")
        else:
            torch.save({"state_dict": {**state, "proj": projection}, "kwargs": {}}, folder / f"{kind}.pth.tar")
        branches.append((kind, model, projection.double(), imagenet if kind == "dino" else clip))

    def embed(image, kinds):
        small = resized_like_pillow(image, side, side)
        pixels = torch.from_numpy(small.copy()).permute(2, 0, 1)[None].double() / 255
        parts = []
        for kind, model, projection, (mean, deviation) in branches[:kinds]:
            x = (pixels - torch.tensor(mean).double()[:, None, None]) / torch.tensor(deviation).double()[:, None, None]
            with torch.no_grad():
                if kind == "dino":
                    kept = []
                    hook = model.blocks[-1].register_forward_hook(lambda *a: kept.append(a[2]))
                    model(x)
                    hook.remove()
                    parts.append(kept[0][:, 0])
                else:
                    parts.append(model(x) @ projection)
        e = torch.cat(parts, -1)
        e = e - e.mean(-1, keepdim=True)
        return e / e.norm(dim=-1, keepdim=True)

    tensors = {}
    for i in range(3):
        tensors[f"in/image{i}"] = picture(f"dreamsim/{i}", 48, 40)
    distances = {}
    for kinds, label in [(1, "dino"), (3, "ensemble")]:
        for a, b in [(0, 1), (0, 2), (1, 2)]:
            e = [embed(tensors[f"in/image{k}"], kinds) for k in (a, b)]
            distances[f"{label}/{a}{b}"] = float(1 - torch.nn.functional.cosine_similarity(*e)[0])
    save_file(tensors, folder / "dreamsim.safetensors")
    for label, count in [("dino", 1), ("ensemble", 3)]:
        sub = folder / f"{label}_lora"
        sub.mkdir(exist_ok=True)
        config = {"peft_type": "LORA", "r": rank, "lora_alpha": alpha, "lora_dropout": 0.3, "bias": "none", "target_modules": ["qkv"]}
        (sub / "adapter_config.json").write_text(json.dumps(config, indent=1) + "\n")
        part = {k: v for k, v in adapter.items() if int(k.split(".")[3]) < count}
        if label == "dino":
            save_file({k: v.numpy() for k, v in part.items()}, sub / "adapter_model.safetensors")
        else:
            torch.save(part, sub / "adapter_model.bin")
    shape = dict(width=width, depth=depth, heads=heads, patch=patch, side=side, projection=projected)
    (folder / "dreamsim.json").write_text(json.dumps({"shape": shape, "distances": distances}, indent=1) + "\n")


if __name__ == "__main__":
    target = pathlib.Path(sys.argv[1])
    target.mkdir(parents=True, exist_ok=True)
    resizing(target)
    dreamsim(target)
    inception(target)
    print(sum(f.stat().st_size for f in target.rglob("*") if f.is_file()), "bytes")
