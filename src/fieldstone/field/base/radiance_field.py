"""What every radiance field offers: colours along rays, and training step by step.

A field lives in normalised coordinates (`FieldFrame`); everything outside of `field/` speaks of the world. Rendering
asks for no more than a `RayRenderer`, so images, videos and metrics know nothing of networks or grids.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float

from fieldstone.geometry.sim3 import Sim3
from fieldstone.scene.rays import Rays


@dataclass(frozen=True, eq=False)
class RenderedRays:
    """What each ray sees.

    rgb: sRGB in [0, 1], composited on the background of the field. opacity: share of the light that the field
    stopped, in [0, 1]. depth: expected distance at which the ray ends, light that passes ending at `far`.
    """

    rgb: Float[np.ndarray, "r 3"]
    depth: Float[np.ndarray, "r"]
    opacity: Float[np.ndarray, "r"]


RayRenderer = Callable[[Rays], RenderedRays]
"""Anything that turns rays into colours; rays and depths are in one and the same frame."""


@dataclass(frozen=True, eq=False)
class FieldFrame:
    """Where a field lives: its coordinates, the range of its rays, and what lies behind everything.

    near, far: distances along unit rays, in normalised units.
    """

    normalized_from_world: Sim3
    near: float
    far: float
    background: Float[np.ndarray, "3"]

    def __post_init__(self) -> None:
        if not 0 <= self.near < self.far:
            raise ValueError(f"a field needs 0 <= near < far, got near {self.near} and far {self.far}")

    def normalize(self, rays_in_world: Rays) -> Rays:
        """The same rays in normalised coordinates, directions of unit length again."""
        R = self.normalized_from_world.R
        origins = self.normalized_from_world.apply(rays_in_world.origins)
        return Rays(origins, rays_in_world.directions @ R.T, rays_in_world.pixel_radius)


def in_world(render_normalized: RayRenderer, frame: FieldFrame) -> RayRenderer:
    """The renderer for rays in the world, with depths in world units, of one for normalised coordinates."""

    def render(rays_in_world: Rays, /) -> RenderedRays:
        rendered = render_normalized(frame.normalize(rays_in_world))
        return RenderedRays(rendered.rgb, rendered.depth / frame.normalized_from_world.scale, rendered.opacity)

    return render


def surface_depth(
    depth: Float[np.ndarray, "*n"], opacity: Float[np.ndarray, "*n"], far: float, least: float = 0.5
) -> Float[np.ndarray, "*n"]:
    """Mean distance of what rays meet; infinite where no more than the share `least` of the light is stopped.

    Args:
        far: Where light that passes ends in `RenderedRays.depth`, in its unit.
    """
    return np.where(opacity > least, (depth - (1.0 - opacity) * far) / np.maximum(opacity, least), np.inf)


@dataclass(frozen=True)
class StepReport:
    """What one training step found, before it moved the parameters."""

    loss: float
    mse: float
    """Mean squared colour error of the final colours of the batch, in [0, 1]^2."""


S = TypeVar("S")


@runtime_checkable
class FieldTraining(Protocol[S]):
    """How one kind of field is trained; S is everything that the next step depends on.

    The same state always leads to the same next state, whatever the number of threads: random numbers come from
    streams that are named by (seed, step), never from a generator that lives on between steps. A state is given away
    when it is stepped, for its arrays may be stepped in place: copying grids would take longer than the step. To keep
    one, keep its tensors.
    """

    def start(self) -> S:
        """The state before the first step."""
        ...

    def advance(self, state: S, /) -> tuple[S, StepReport]:
        """One optimisation step; `state` is given away, and must not be used again."""
        ...

    def to_tensors(self, state: S, /) -> dict[str, np.ndarray]:
        """The whole state as named arrays for a checkpoint; `step` among them, the number of steps done."""
        ...

    def from_tensors(self, tensors: Mapping[str, np.ndarray], /) -> S:
        """The state of a checkpoint.

        Raises:
            InputError: An array is missing or has the wrong shape.
        """
        ...

    def renderer(self, state: S, /) -> RayRenderer:
        """Renders rays in normalised coordinates with the field as it is now."""
        ...
