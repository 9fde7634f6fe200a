//! Drawing Gaussians in a browser, for pages of one's own.

/// A classic script without dependencies. It defines the class `Viewer`: `new Viewer(canvas, {up, background})` draws with WebGL 2, or
/// with the processor where there is no graphics card, and turns by mouse, fingers and keys; `setGaussians(rows)` takes a `Float32Array`
/// of 14 channels per Gaussian and may be called at any time; `frameAll()` looks at all of them; `setCamera(camera)` looks through a given pinhole camera until the next turn.
pub const SCRIPT: &str = include_str!("viewer.js");
