#!/usr/bin/env python3
"""Measures gsplat and PyTorch on the shapes of `freerange bench`, on the same device, in the same run, and prints ratios.

    cargo build --release --features cuda
    pip install torch gsplat numpy
    python tools/bench_peers.py target/release/freerange --device cuda:0

The scene of the rasteriser is that of `freerange bench` (apps/freerange/src/commands/bench/kernels.rs). The PyTorch block is
the same arithmetic: adaLN-Zero, RMS norm of queries and keys, scaled_dot_product_attention, GEGLU; autocast to bf16 around
a residual stream of 32 bits; compiled with torch.compile. Arguments that this program does not know, such as
`--sizes paper`, go to `freerange bench`. Times are medians of calls that were waited for, as ours.
"""
import argparse
import json
import math
import platform
import subprocess
import sys
import time

import numpy as np
import torch
import torch.nn.functional as F


def median_seconds(call, device, seconds):
    def wait():
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    for _ in range(3):
        call()
        wait()
    times, begin = [], time.perf_counter()
    while len(times) < 3 or (len(times) < 200 and time.perf_counter() - begin < seconds):
        start = time.perf_counter()
        call()
        wait()
        times.append(time.perf_counter() - start)
    return sorted(times)[len(times) // 2]


def unit(i, k):
    x = np.sin(i * 12.9898 + k * 78.233) * 43758.5453
    return x - np.floor(x)


def scene(n):
    """Means [n, 3], quaternions wxyz [n, 4], scales [n, 3], opacities [n], colours [n, 3]."""
    i = np.arange(n, dtype=np.float64)
    spacing = math.sqrt(math.pi / n)
    z = 1 - 2 * (i + 0.5) / n
    phi = i * math.pi * (3 - math.sqrt(5))
    r = np.sqrt(1 - z * z)
    normal = np.stack([r * np.cos(phi), r * np.sin(phi), z], 1)
    means = normal * (0.45 + 0.05 * np.sin(7 * normal[:, :1]) * np.cos(5 * normal[:, 1:2]))
    half = normal + np.array([0, 0, 1.0])
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    quats = np.concatenate([np.zeros((n, 1)), half], 1)
    scales = np.stack([spacing * flat * (0.4 + 0.4 * unit(i, k)) for k, flat in enumerate([1, 1, 0.1])], 1)
    opacities = 1 / (1 + np.exp(-(5 * unit(i, 3) - 1)))
    colors = np.stack([unit(i, k) for k in (4, 5, 6)], 1)
    return [torch.tensor(x, dtype=torch.float32) for x in (means, quats, scales, opacities, colors)]


def cameras(count, size):
    """World to camera [count, 4, 4] (x right, y down, z forward), intrinsics [count, 3, 3]."""
    focal = size / 2 / math.tan(math.radians(49) / 2)
    views = []
    for i in range(count):
        c, s = math.cos(1.7 * i), math.sin(1.7 * i)
        eye = np.array([1.4 * c, 1.4 * s, 0.54])
        forward = -eye / np.linalg.norm(eye)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        m = np.eye(4)
        m[:3, :3] = np.stack([right, down, forward])
        m[:3, 3] = -m[:3, :3] @ eye
        views.append(m)
    k = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return torch.tensor(np.stack(views), dtype=torch.float32), torch.tensor(np.stack([k] * count), dtype=torch.float32)


def gsplat_seconds(line, device, seconds):
    from gsplat import rasterization

    parts = [x.to(device) for x in scene(line["gaussians"])]
    views, k = (x.to(device) for x in cameras(line["images"], line["pixels"]))
    white = torch.ones(line["images"], 3, device=device)

    def render(means, quats, scales, opacities, colors):
        size = line["pixels"]
        return rasterization(means, quats, scales, opacities, colors, views, k, size, size, backgrounds=white, packed=False)[:2]

    def forward():
        with torch.no_grad():
            render(*parts)

    leaves = [x.clone().requires_grad_() for x in parts]

    def both():
        image, alpha = render(*leaves)
        torch.autograd.grad(image.square().sum() + alpha.square().sum(), leaves)

    return median_seconds(forward, device, seconds), median_seconds(both, device, seconds)


class Attention(torch.nn.Module):
    def __init__(self, d, heads):
        super().__init__()
        self.heads = heads
        self.q_norm = torch.nn.Parameter(torch.ones(d // heads))
        self.k_norm = torch.nn.Parameter(torch.ones(d // heads))

    def forward(self, qkv):
        b, t, d3 = qkv.shape
        q, k, v = qkv.view(b, t, 3, self.heads, d3 // 3 // self.heads).permute(2, 0, 3, 1, 4)
        q = F.rms_norm(q, q.shape[-1:], self.q_norm.to(q.dtype), 1e-6)
        k = F.rms_norm(k, k.shape[-1:], self.k_norm.to(k.dtype), 1e-6)
        return F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(b, t, d3 // 3)


class Block(torch.nn.Module):
    def __init__(self, d, heads, ffn):
        super().__init__()
        self.adaln = torch.nn.Linear(d, 6 * d)
        self.qkv = torch.nn.Linear(d, 3 * d)
        self.attention = Attention(d, heads)
        self.out = torch.nn.Linear(d, d)
        self.proj_in = torch.nn.Linear(d, 2 * ffn)
        self.proj_out = torch.nn.Linear(ffn, d)

    def forward(self, x, c):
        shift_a, scale_a, gate_a, shift_f, scale_f, gate_f = self.adaln(F.silu(c)).unsqueeze(1).chunk(6, -1)

        def norm(x, shift, scale):
            return F.layer_norm(x, x.shape[-1:], eps=1e-6) * (1 + scale) + shift

        x = x + gate_a * self.out(self.attention(self.qkv(norm(x, shift_a, scale_a))))
        a, g = self.proj_in(norm(x, shift_f, scale_f)).chunk(2, -1)
        return x + gate_f * self.proj_out(a * F.gelu(g))


def torch_seconds(line, device, compute, seconds, compiled):
    b, t, d = line["batch"], line["tokens"], line["hidden"]
    torch.manual_seed(0)
    half = {"f32": None, "bf16": torch.bfloat16, "f16": torch.float16}[compute]
    block = Block(d, line["heads"], line["ffn"]).to(device)
    run = torch.compile(block) if compiled else block
    attention = torch.compile(block.attention) if compiled else block.attention
    x, c = torch.randn(b, t, d, device=device), torch.randn(b, d, device=device)
    qkv = torch.randn(b, t, 3 * d, device=device, dtype=half or torch.float32)

    def measure(module, first, *rest):
        def call(*inputs):
            with torch.autocast(device.type, dtype=half or torch.bfloat16, enabled=half is not None):
                return module(*inputs)

        def forward():
            with torch.no_grad():
                call(first, *rest)

        leaf = first.clone().requires_grad_()
        weights = [p for p in block.parameters()] if module is run else []

        def both():
            y = call(leaf, *rest)
            torch.autograd.grad(y.float().sum(), [leaf, *weights], allow_unused=True)

        return median_seconds(forward, device, seconds), median_seconds(both, device, seconds)

    return measure(attention, qkv), measure(run, x, c)


def row(*cells):
    print("| " + " | ".join(str(c) for c in cells) + " |", flush=True)


def header(*cells):
    print()
    row(*cells)
    print("|" + "---|" * len(cells), flush=True)


def ms(seconds):
    return f"{seconds * 1e3:.3g}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("binary", help="freerange, built with the device's feature")
    parser.add_argument("--device", default="cuda:0", help="as `freerange bench --device` takes it")
    parser.add_argument("--torch-device", help="the same device for PyTorch [default: the same name]")
    parser.add_argument("--seconds", type=float, default=1.0, help="time per line")
    parser.add_argument("--no-compile", action="store_true", help="PyTorch without torch.compile")
    args, rest = parser.parse_known_args()
    torch.backends.cuda.matmul.allow_tf32 = True  # what a fast run in 32 bits would use
    device = torch.device(args.torch_device or args.device)
    command = [args.binary, "bench", "--device", args.device, "--only", "raster,block", "--seconds", str(args.seconds), "--json"]
    ours = json.loads(subprocess.run(command + rest, check=True, stdout=subprocess.PIPE).stdout)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or platform.machine()
    print(f"device: {ours['device']} ({ours['hardware']}); PyTorch {torch.__version__} on {device} ({name})")
    print(f"program: freerange {ours['version']}, commit {ours['commit']}, compute {ours['compute']}")
    print("command: " + " ".join(sys.argv))

    if ours["raster"]:
        try:
            if device.type != "cuda":
                raise RuntimeError("needs a CUDA device")
            import gsplat

            reason = None
            print(f"gsplat {gsplat.__version__}")
        except (ImportError, RuntimeError) as e:
            reason = str(e)
            print(f"gsplat: not measured ({reason})")
        header("Gaussians", "images", "px", "ours fwd, ms", "gsplat fwd, ms", "ratio", "ours fwd+bwd, ms", "gsplat fwd+bwd, ms", "ratio")
        for line in ours["raster"]:
            mine = line["forward_seconds"], line["both_seconds"]
            theirs = (math.nan, math.nan) if reason else gsplat_seconds(line, device, args.seconds)
            cells = [x for m, t in zip(mine, theirs) for x in (ms(m), ms(t), f"{m / t:.2f}")]
            row(line["gaussians"], line["images"], line["pixels"], *cells)

    if ours["block"]:
        header("size", "what", "ours fwd, ms", "PyTorch fwd, ms", "ratio", "ours fwd+bwd, ms", "PyTorch fwd+bwd, ms", "ratio")
        for line in ours["block"]:
            attention, block = torch_seconds(line, device, ours["compute"], args.seconds, not args.no_compile)
            pairs = [
                ("attention", (line["attention_forward_seconds"], line["attention_both_seconds"]), attention),
                ("block", (line["forward_seconds"], line["both_seconds"]), block),
            ]
            for what, mine, theirs in pairs:
                cells = [x for m, t in zip(mine, theirs) for x in (ms(m), ms(t), f"{m / t:.2f}")]
                row(f"{line['size']} ({line['batch']} x {line['tokens']} x {line['hidden']})", what, *cells)


if __name__ == "__main__":
    main()
