"""The part in Rust: checked numbers in, bytes out. The package's own functions are the interface."""

from collections.abc import Callable
from os import PathLike
from typing import Any, final

_Camera = tuple[int, int, tuple[float, ...], list[list[float]]]
_View = tuple[str, _Camera, bytes]
_Told = tuple[str, _Camera, bytearray]
# Whether something is left out or may be wrong, and the sentence.
_Notes = list[tuple[bool, str]]
# Rows, the degree of the harmonics, and these.
_Splats = tuple[bytearray, int, bytearray]
_Result = tuple[list[bytearray], tuple[float, float, float], _Notes, list[tuple[str, float]]]
_Up = str | tuple[float, float, float]
_OnStep = Callable[[str, int, int, int, float | None, bytearray | None], None]

__all__ = [
    "Model",
    "Rendered",
    "Scene",
    "__version__",
    "devices",
    "load",
    "rasterize",
    "read_gaussians",
    "read_scene",
    "reference",
    "scene_of_views",
    "seen_from",
    "transform",
    "write_gaussians",
]

__version__: str

def devices() -> list[tuple[str, str, str | None]]: ...
def load(checkpoint: str | PathLike[str] | None, device: str, encoder_weights: str | PathLike[str] | None) -> Model: ...
def read_scene(path: str | PathLike[str], photos: dict[str, Any], up: _Up) -> Scene: ...
def scene_of_views(
    raw: list[_View], up: _Up, center: tuple[float, float, float] | None, radius: float | None
) -> Scene: ...
def read_gaussians(
    path: str | PathLike[str], up: tuple[float, float, float] | None
) -> tuple[_Splats, tuple[float, float, float], _Notes]: ...
def write_gaussians(
    rows: bytes, degree: int, harmonics: bytes, path: str | PathLike[str], up: tuple[float, float, float]
) -> _Notes: ...
def transform(
    rows: bytes,
    degree: int,
    harmonics: bytes,
    scale: float,
    rotation: tuple[float, float, float, float],
    translation: tuple[float, float, float],
) -> _Splats: ...
def seen_from(rows: bytes, degree: int, harmonics: bytes, eye: tuple[float, float, float]) -> bytearray: ...
def rasterize(
    rows: bytes, raw: list[_Camera], backgrounds: list[tuple[float, float, float]], depth: bool
) -> Rendered: ...
def reference(rows: bytes, raw: _Camera, background: tuple[float, float, float]) -> tuple[bytearray, bytearray]: ...

@final
class Model:
    @property
    def device(self) -> str: ...
    @property
    def network_views(self) -> int: ...
    @property
    def gaussians(self) -> int: ...
    @property
    def provenance(self) -> str: ...
    def check(self, chosen: dict[str, Any]) -> None: ...
    def reconstruct_scene(self, scene: Scene, chosen: dict[str, Any], on_step: _OnStep | None) -> _Result: ...

@final
class Scene:
    def views(self) -> list[_Told]: ...
    def further(self) -> list[_Told]: ...
    def notes(self) -> _Notes: ...

@final
class Rendered:
    def rgb(self) -> bytearray: ...
    def alpha(self) -> bytearray: ...
    def depth(self) -> bytearray: ...
    def backward(self, d_rgb: bytes, d_alpha: bytes, d_depth: bytes) -> tuple[bytearray, bytearray]: ...
