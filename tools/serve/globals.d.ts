// What the page's modules have of the viewer. The viewer's is a script of its own, shown here as the page sees it.
interface Pinhole { width: number; height: number; fx: number; fy: number; cx: number; cy: number; world_to_camera: number[] }
interface Orbit { target: number[]; azimuth: number; elevation: number; distance: number; fov: number }
declare const BUDGET: number;
declare class Viewer {
  constructor(canvas: HTMLCanvasElement, options: { up: number[]; background: number[] });
  canvas: HTMLCanvasElement;
  background: number[];
  camera: Pinhole | null;
  orbit: Orbit;
  near: number;
  count: number;
  rows: Float32Array;
  frames: number;
  onmove: ((viewer: Viewer) => void) | null;
  ondraw: ((viewer: Viewer) => void) | null;
  budget: number;
  size(scale?: number): number[];
  setGaussians(rows: Float32Array): void;
  frameSphere(target: number[], radius: number): void;
  setCamera(camera: Pinhole): void;
  leaveCamera(): void;
  pose(): { right: number[]; down: number[]; forward: number[]; eye: number[] };
  lens(size: number[]): { focal: number[]; middle: number[] };
  redraw(): void;
  draw(): void;
  do(name: string): void;
  turn(azimuth: number, elevation: number): void;
}
interface Window { viewers?: Viewer[] }
