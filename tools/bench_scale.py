"""Measures how a reconstruction scales: see bench_scale.sh, which runs this.

The scene is a torus of colored Gaussians on white. The program itself renders it small; each pixel then becomes a block of a
JPEG, which costs a decoder what any photo of that size costs but for its file's bytes: a camera's are ten times larger.
Masks are those of the plain background. Numbers of Gaussians follow the resolution of the optimization, as in the program; so
they are reached with more pixels, too. The rasterizer alone, forward and backward at 512 px, is measured beside them.
"""
import json
import math
import multiprocessing
import os
import pathlib
import random
import struct
import subprocess
import sys
import time
import zlib

SMALL, BLOCK, COUNT = (500, 375), 8, 300
FOCAL = 3500 / 4000  # of the width
WIDTH, HEIGHT, LEFT, RIGHT, TOP, GAP = 760, 640, 70, 30, 60, 70
BLUE, ORANGE, GRAY = "#1f77b4", "#d9601a", "#777"


def numbers(name, default):
    return [int(n) for n in os.environ.get(name, default).split()]


def write_cloud(path):
    """A torus about z, each Gaussian with a color of its place, as INRIA's files have it."""
    draw = random.Random(1)
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    rows = []
    for _ in range(12_000):
        a, b = draw.uniform(0, math.tau), draw.uniform(0, math.tau)
        r = 0.33 + (0.12 + 0.03 * math.sin(5 * a)) * math.cos(b)
        color = [0.15 + 0.5 * (0.5 + 0.5 * math.sin(k * a + 2 * j + b)) for j, k in enumerate((3, 4, 7))]
        rows.append([r * math.cos(a), r * math.sin(a), 0.15 * math.sin(b), *[(c - 0.5) / 0.28209479177387814 for c in color], 6.0, *[math.log(0.012)] * 3, 1.0, 0.0, 0.0, 0.0])
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *[f"property float {name}" for name in names], "end_header"]
    path.write_bytes(("\n".join(head) + "\n").encode() + b"".join(struct.pack("<14f", *row) for row in rows))


def frame(i, name, width, height):
    """A camera 1.75 from the origin, on a spiral from high above to a little below."""
    z, turn = 0.8 - 0.95 * (i + 0.5) / COUNT, 2.399963 * i
    flat = math.sqrt(1 - z * z)
    back = [flat * math.cos(turn), flat * math.sin(turn), z]
    right = [-math.sin(turn), math.cos(turn), 0.0]
    up = [back[1] * right[2] - back[2] * right[1], back[2] * right[0] - back[0] * right[2], back[0] * right[1] - back[1] * right[0]]
    matrix = [[right[k], up[k], back[k], 1.75 * back[k]] for k in range(3)] + [[0.0, 0.0, 0.0, 1.0]]
    focal = FOCAL * width
    return {"file_path": name, "w": width, "h": height, "fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2, "transform_matrix": matrix}


def write_cameras(path, frames):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"camera_model": "PINHOLE", "frames": frames}))


def pixels(path):
    """Red, green and blue of an 8-bit PNG: width, height and a list of triples."""
    data, at, packed = path.read_bytes(), 8, b""
    while at < len(data):
        (size,), kind = struct.unpack(">I", data[at : at + 4]), data[at + 4 : at + 8]
        chunk = data[at + 8 : at + 8 + size]
        if kind == b"IHDR":
            w, h, depth, color = struct.unpack(">IIBB", chunk[:10])
            assert depth == 8 and color in (2, 6) and chunk[12] == 0, f"{path}: expected 8 bits, RGB or RGBA"
            step = 3 if color == 2 else 4
        elif kind == b"IDAT":
            packed += chunk
        at += 12 + size
    raw, wide = zlib.decompress(packed), w * step
    before, out = bytearray(wide), []
    for y in range(h):
        how, row = raw[y * (wide + 1)], bytearray(raw[y * (wide + 1) + 1 : (y + 1) * (wide + 1)])
        if how == 2:
            row = bytearray((a + b) & 255 for a, b in zip(row, before))
        elif how:
            for i in range(wide):
                left, up, corner = (row[i - step], before[i], before[i - step]) if i >= step else (0, before[i], 0)
                if how == 4:
                    p = left + up - corner
                    a, b, c = abs(p - left), abs(p - up), abs(p - corner)
                    guess = left if a <= b and a <= c else up if b <= c else corner
                else:
                    guess = left if how == 1 else (left + up) // 2
                row[i] = (row[i] + guess) & 255
        out += zip(row[::step], row[1::step], row[2::step])
        before = row
    return w, h, out


def jpeg(w, h, rgb):
    """A baseline JPEG in which each pixel is a block of 8 x 8, by its first coefficient alone."""
    dc = ["00", "010", "011", "100", "101", "110", "1110", "11110", "111110", "1111110"]
    words = {}
    for d in range(-255, 256):
        size = abs(d).bit_length()
        value = format(d if d > 0 else d + (1 << size) - 1, f"0{size}b") if size else ""
        words[d] = dc[size] + value + "00"  # and the end of the block
    known = {}
    before, bits = (128, 128, 128), []
    for color in rgb:
        now = known.get(color)
        if now is None:
            r, g, b = color
            full = (0.299 * r + 0.587 * g + 0.114 * b, 128 - 0.168736 * r - 0.331264 * g + 0.5 * b, 128 + 0.5 * r - 0.418688 * g - 0.081312 * b)
            now = known[color] = tuple(min(255, max(0, round(v))) for v in full)
        bits += (words[now[0] - before[0]], words[now[1] - before[1]], words[now[2] - before[2]])
        before = now
    bits = "".join(bits)
    bits += "1" * (-len(bits) % 8)
    scan = int(bits, 2).to_bytes(len(bits) // 8, "big").replace(b"\xff", b"\xff\x00")

    def segment(mark, body):
        return bytes([0xFF, mark]) + struct.pack(">H", len(body) + 2) + body

    return b"".join([
        b"\xff\xd8",
        segment(0xE0, b"JFIF\0\1\1\0\0\1\0\1\0\0"),
        segment(0xDB, bytes([0, 8] + [1] * 63)),
        segment(0xC0, struct.pack(">BHHB", 8, BLOCK * h, BLOCK * w, 3) + bytes([1, 0x11, 0, 2, 0x11, 0, 3, 0x11, 0])),
        segment(0xC4, bytes([0x00, 0, 1, 5, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0, *range(12)])),
        segment(0xC4, bytes([0x10, 0, 2, *[0] * 14, 0x00, 0xF0])),
        segment(0xDA, bytes([3, 1, 0, 2, 0, 3, 0, 0, 63, 0])),
        scan,
        b"\xff\xd9",
    ])


def make_photo(paths):
    source, target = paths
    if not target.is_file():
        half = target.with_suffix(".part")
        half.write_bytes(jpeg(*pixels(source)))
        half.rename(target)


def run(command):
    """Seconds and peak memory in bytes of a command, and what it prints."""
    begin = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    printed = process.stdout.read().decode()
    _, status, used = os.wait4(process.pid, 0)
    if status:
        sys.exit(f"failed: {' '.join(map(str, command))}")
    unit = 1 if sys.platform == "darwin" else 1024
    return time.monotonic() - begin, used.ru_maxrss * unit, printed


def photos(binary, place):
    """The scene: 300 photos, made once."""
    names = [f"{i:03}" for i in range(COUNT)]
    folder = place / "photos"
    folder.mkdir(parents=True, exist_ok=True)
    if not all((folder / f"{name}.jpg").is_file() for name in names):
        print("photos ...", flush=True)
        write_cloud(place / "torus.ply")
        write_cameras(place / "render/transforms.json", [frame(i, f"{name}.png", *SMALL) for i, name in enumerate(names)])
        run([binary, "render", place / "torus.ply", "--cameras", place / "render/transforms.json", "-o", place / "render/pictures"])
        with multiprocessing.Pool() as pool:
            pool.map(make_photo, [(place / f"render/pictures/{name}.png", folder / f"{name}.jpg") for name in names], 1)
    return names


def reconstructed(binary, place, names, count, key, options):
    """One run, unless its numbers are there already."""
    record = place / f"{key}.json"
    if record.is_file():
        return json.loads(record.read_text())
    scene, out = place / f"photos-{count}.json", place / "out" / key
    chosen = [i * COUNT // count for i in range(count)]
    write_cameras(scene, [frame(i, f"photos/{names[i]}.jpg", BLOCK * SMALL[0], BLOCK * SMALL[1]) for i in chosen])
    seconds, peak, _ = run([binary, "reconstruct", scene, "-o", out, "--masks", "plain", *options, *os.environ.get("OPTIONS", "").split()])
    report = json.loads((out / "report.json").read_text())
    found = {"photos": count, "gaussians": report["gaussians"], "seconds": seconds, "peak": peak, "stages": dict(report["seconds"])}
    record.write_text(json.dumps(found))
    return found


def print_table(title, head, rows):
    print(f"\n{title}\n\n| {' | '.join(head)} |\n|{'---|' * len(head)}")
    for row in rows:
        print(f"| {' | '.join(row)} |")


def told(found, first):
    stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in found["stages"].items())
    return [f"{found[first]:,}", f"{found['seconds']:.1f}", f"{found['peak'] / 2**20:.0f}", stages]


def plot(by_photos, by_gaussians, raster):
    """Seconds above, memory below; photos along the bottom, Gaussians along the top."""
    panel = (HEIGHT - 2 * TOP - GAP) / 2

    def scale(values, low, high):
        a, b = math.log(min(values)), math.log(max(values))
        return lambda v: low + (high - low) * (math.log(v) - a) / max(b - a, 1e-9)

    x_photos = scale([f["photos"] for f in by_photos] or [1], LEFT, WIDTH - RIGHT)
    x_gaussians = scale([f["gaussians"] for f in by_gaussians] + [r["gaussians"] for r in raster] or [1], LEFT, WIDTH - RIGHT)
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" font-size="12">',
        "<title>Seconds and peak memory by photos and by Gaussians</title>",
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>',
    ]
    thousand = [(r["gaussians"], 1000 * r["both_seconds"]) for r in raster]
    series = {
        "seconds": [
            (BLUE, x_photos, [(f["photos"], f["seconds"]) for f in by_photos], ""),
            (ORANGE, x_gaussians, [(f["gaussians"], f["seconds"]) for f in by_gaussians], ""),
            (ORANGE, x_gaussians, thousand, ' stroke-dasharray="5 4"'),
        ],
        "MiB": [
            (BLUE, x_photos, [(f["photos"], f["peak"] / 2**20) for f in by_photos], ""),
            (ORANGE, x_gaussians, [(f["gaussians"], f["peak"] / 2**20) for f in by_gaussians], ""),
        ],
    }
    for number, (unit, lines) in enumerate(series.items()):
        top = TOP + number * (panel + GAP)
        values = [v for _, _, points, _ in lines for _, v in points]
        y = scale([10 ** math.floor(math.log10(min(values))), 10 ** math.ceil(math.log10(max(values)))], top + panel, top)
        for power in range(math.floor(math.log10(min(values))), math.ceil(math.log10(max(values))) + 1):
            for times in (1, 2, 5):
                value = times * 10.0**power
                if top - 1 <= y(value) <= top + panel + 1:
                    out.append(f'<path d="M{LEFT} {y(value):.1f}H{WIDTH - RIGHT}" stroke="#ddd"/><text x="{LEFT - 8}" y="{y(value) + 4:.1f}" text-anchor="end">{value:g}</text>')
        out.append(f'<text x="{LEFT}" y="{top - 28}" font-weight="bold">{unit}</text>')
        for color, x, points, dash in lines:
            line = " ".join(f"{x(n):.1f},{y(v):.1f}" for n, v in points)
            out.append(f'<polyline points="{line}" fill="none" stroke="{color}" stroke-width="2"{dash}/>')
            out += [f'<circle cx="{x(n):.1f}" cy="{y(v):.1f}" r="3" fill="{color}"/>' for n, v in points]
        for f in by_photos:
            out.append(f'<text x="{x_photos(f["photos"]):.1f}" y="{top + panel + 18:.1f}" text-anchor="middle" fill="{BLUE}">{f["photos"]}</text>')
        for n in sorted({f["gaussians"] for f in by_gaussians} | {r["gaussians"] for r in raster}):
            text = f"{n / 1024:.0f}K"
            out.append(f'<text x="{x_gaussians(n):.1f}" y="{top - 8:.1f}" text-anchor="middle" fill="{ORANGE}">{text}</text>')
    middle = (LEFT + WIDTH - RIGHT) / 2
    out.append(f'<text x="{middle}" y="20" text-anchor="middle" fill="{ORANGE}">Gaussians, 4 photos (dashed: 1,000 steps of the rasterizer, 512 px)</text>')
    out.append(f'<text x="{middle}" y="{HEIGHT - 12}" text-anchor="middle" fill="{BLUE}">photos of 12 megapixels</text>')
    out.append("</svg>")
    return "\n".join(out) + "\n"


def main():
    binary = sys.argv[1]
    place = pathlib.Path(sys.argv[2] if len(sys.argv) > 2 else "/tmp/freerange-scale").resolve()
    target = pathlib.Path(sys.argv[3]) if len(sys.argv) > 3 else place / "scale.svg"
    names = photos(binary, place)
    by_photos, by_gaussians = [], []
    for count in numbers("PHOTOS", "4 16 64 300"):
        print(f"{count} photos ...", flush=True)
        by_photos.append(reconstructed(binary, place, names, count, f"by-photos-{count}", []))
    for count in numbers("GAUSSIANS", "2048 8192 16384 32768 65536"):
        print(f"{count} Gaussians ...", flush=True)
        # The network makes 2,048; the optimization 8,192 for each 256 pixels, before the layer. The table has the true number.
        side = count // 32
        options = ["--iterations", "0"] if count < 8192 else ["--set", f"optimize.max_resolution={side}", "--max-resolution", str(max(1024, 2 * side))]
        by_gaussians.append(reconstructed(binary, place, names, 4, f"by-gaussians-{count}", ["--symmetry", "off", *options]))
    chosen = ",".join(map(str, numbers("RASTER", "2048 8192 32768 131072 262144")))
    record = place / "raster.json"
    if not record.is_file():
        print("rasterizer ...", flush=True)
        record.write_text(run([binary, "bench", "--device", "cpu", "--only", "raster", "--gaussians", chosen, "--images", "1", "--pixels", "512", "--json"])[2])
    raster = json.loads(record.read_text())["raster"]
    head = ["seconds", "peak, MiB", "seconds by stage"]
    print_table("By photos of 4000 x 3000 pixels", ["photos", *head], [told(f, "photos") for f in by_photos])
    print_table("By Gaussians, 4 photos, --symmetry off", ["Gaussians", *head], [told(f, "gaussians") for f in by_gaussians])
    rows = [[f"{r['gaussians']:,}", f"{1e3 * r['forward_seconds']:.1f}", f"{1e3 * r['both_seconds']:.1f}"] for r in raster]
    print_table("The rasterizer, one image of 512 px", ["Gaussians", "forward, ms", "forward and backward, ms"], rows)
    target.write_text(plot(by_photos, by_gaussians, raster))
    print(f"\n{target}")


if __name__ == "__main__":
    main()
