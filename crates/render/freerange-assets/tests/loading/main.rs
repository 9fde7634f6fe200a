//! Mesh files: each feature by the values it must give, each hostile file by the reason it is refused for.

mod features;
mod glb;
mod hostile;
mod materials;
mod real;
mod text;
