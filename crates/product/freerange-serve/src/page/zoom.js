// Zoom and pan of an image that fills a canvas of its own size.

const MOST = 16;

export class Zoom {
  /** Times that the image is larger than the canvas, and the corner of what is seen. */
  scale = 1;
  corner = [0, 0];

  /** @param {number[]} size of the image in pixels */
  constructor(size) { this.size = size; }

  /** Where a place of the canvas lies in the image; both in pixels. @param {number[]} at */
  inside(at) { return at.map((v, i) => this.corner[i] + v / this.scale); }

  /**
   * Where a place of the image lies on the canvas.
   * @param {number[]} place
   * @returns {[number, number]}
   */
  outside([x, y]) { return [(x - this.corner[0]) * this.scale, (y - this.corner[1]) * this.scale]; }

  /**
   * Larger or smaller by a factor; this place of the image stays where it is.
   * @param {number} factor
   * @param {number[]} place
   */
  by(factor, place) {
    const before = this.scale;
    this.scale = Math.max(1, Math.min(MOST, before * factor));
    this.corner = place.map((v, i) => v - (v - this.corner[i]) * before / this.scale);
    this.pan([0, 0]);
  }

  /** Moves what is seen, in pixels of the image; nothing beside it is shown. @param {number[]} by */
  pan(by) { this.corner = this.corner.map((v, i) => Math.max(0, Math.min(this.size[i] * (1 - 1 / this.scale), v + by[i]))); }

  /** Brings a place of the image into sight. @param {number[]} place */
  follow(place) {
    this.pan(place.map((v, i) => {
      const seen = this.size[i] / this.scale, edge = seen / 10, low = this.corner[i] + edge, high = this.corner[i] + seen - edge;
      return v < low ? v - low : v > high ? v - high : 0;
    }));
  }

  /**
   * @param {OffscreenCanvasRenderingContext2D | CanvasRenderingContext2D} context
   * @param {CanvasImageSource} image
   */
  draw(context, image) {
    const [w, h] = this.size, [x, y] = this.corner;
    context.imageSmoothingEnabled = this.scale < 3;
    context.drawImage(image, x, y, w / this.scale, h / this.scale, 0, 0, w, h);
  }
}
