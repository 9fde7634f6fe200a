// An animated GIF of frames that share one palette.

/** Colors of the palette. */
const COLORS = 256;
/** Values of a channel in the histogram. */
const LEVELS = 32;

/** The mean colors of `COLORS` boxes of the histogram, by median cut, and the box of each entry. @param {Uint8ClampedArray[]} frames RGBA */
const palette = (frames) => {
  const counts = new Uint32Array(LEVELS ** 3), sums = [0, 1, 2].map(() => new Float64Array(LEVELS ** 3));
  for (const frame of frames) {
    for (let i = 0; i < frame.length; i += 4) {
      const entry = entryOf(frame, i);
      counts[entry] += 1;
      for (let c = 0; c < 3; c++) sums[c][entry] += frame[i + c];
    }
  }
  const level = (/** @type {number} */ entry, /** @type {number} */ c) => (entry >> (10 - 5 * c)) & 31;
  /** @param {number[]} entries */
  const boxOf = (entries) => {
    const spans = [0, 1, 2].map((c) => entries.reduce(([low, high], e) => [Math.min(low, level(e, c)), Math.max(high, level(e, c))], [LEVELS, 0]));
    const count = entries.reduce((sum, e) => sum + counts[e], 0), widths = spans.map(([low, high]) => high - low), width = Math.max(...widths);
    return { entries, count, axis: widths.indexOf(width), weight: width * Math.sqrt(count) };
  };
  const boxes = [boxOf([...counts.keys()].filter((e) => counts[e] > 0))];
  while (boxes.length < COLORS) {
    const at = boxes.reduce((best, b, i) => (b.weight > boxes[best].weight ? i : best), 0), { entries, count, axis, weight } = boxes[at];
    if (!weight) break;
    entries.sort((a, b) => level(a, axis) - level(b, axis));
    let cut = 0;
    for (let sum = 0; cut < entries.length - 1 && (cut < 1 || sum < count / 2); cut++) sum += counts[entries[cut]];
    boxes.splice(at, 1, boxOf(entries.slice(0, cut)), boxOf(entries.slice(cut)));
  }
  const colors = new Uint8Array(3 * COLORS), index = new Uint8Array(LEVELS ** 3);
  boxes.forEach(({ entries, count }, i) => {
    entries.forEach((e) => { index[e] = i; });
    for (let c = 0; c < 3; c++) colors[3 * i + c] = Math.round(entries.reduce((sum, e) => sum + sums[c][e], 0) / count);
  });
  return { colors, index };
};

/**
 * @param {Uint8ClampedArray} frame
 * @param {number} i
 */
const entryOf = (frame, i) => ((frame[i] >> 3) << 10) | ((frame[i + 1] >> 3) << 5) | (frame[i + 2] >> 3);

/** LZW as GIF has it: codes of 9 to 12 bits, in blocks of at most 255 bytes. @param {Uint8Array} pixels */
const compressed = (pixels) => {
  const CLEAR = 256, END = 257, MOST = 4096;
  /** @type {number[]} */
  const bytes = [];
  let bits = 9, next = END + 1, held = 0, count = 0;
  /** @type {Map<number, number>} */
  const codes = new Map();
  /** @param {number} code */
  const emit = (code) => {
    held |= code << count;
    for (count += bits; count >= 8; count -= 8, held >>>= 8) bytes.push(held & 255);
  };
  emit(CLEAR);
  let prefix = pixels[0];
  for (const pixel of pixels.subarray(1)) {
    const key = (prefix << 8) | pixel, known = codes.get(key);
    if (known !== undefined) {
      prefix = known;
      continue;
    }
    emit(prefix);
    prefix = pixel;
    if (next === MOST) {
      emit(CLEAR);
      codes.clear();
      [bits, next] = [9, END + 1];
    } else {
      if (next >= 1 << bits) bits += 1;
      codes.set(key, next);
      next += 1;
    }
  }
  emit(prefix);
  emit(END);
  if (count) bytes.push(held & 255);
  const blocks = [];
  for (let at = 0; at < bytes.length; at += 255) {
    const block = bytes.slice(at, at + 255);
    blocks.push(new Uint8Array([block.length, ...block]));
  }
  return [new Uint8Array([8]), ...blocks, new Uint8Array([0])];
};

/** @param {number} v */
const word = (v) => [v & 255, v >> 8];
/** @param {string} text */
const ascii = (text) => [...text].map((c) => c.charCodeAt(0));

/**
 * A GIF that goes on for ever.
 * @param {Uint8ClampedArray[]} frames RGBA, of which alpha does not count
 * @param {number} width
 * @param {number} height
 * @param {number} delay of each frame, in hundredths of a second
 */
export const gif = (frames, width, height, delay) => {
  const { colors, index } = palette(frames);
  /** @type {Uint8Array<ArrayBuffer>[]} */
  const parts = [new Uint8Array([...ascii("GIF89a"), ...word(width), ...word(height), 0xf7, 0, 0]), colors, new Uint8Array([0x21, 0xff, 11, ...ascii("NETSCAPE2.0"), 3, 1, 0, 0, 0])];
  for (const frame of frames) {
    const pixels = new Uint8Array(width * height).map((_, i) => index[entryOf(frame, 4 * i)]);
    parts.push(new Uint8Array([0x21, 0xf9, 4, 4, ...word(delay), 0, 0, 0x2c, 0, 0, 0, 0, ...word(width), ...word(height), 0]), ...compressed(pixels));
  }
  return new Blob([...parts, new Uint8Array([0x3b])], { type: "image/gif" });
};
