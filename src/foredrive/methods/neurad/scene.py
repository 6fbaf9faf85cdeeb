"""A reconstructed scene that is a neural field (Tonderski et al., "NeuRAD", 2024)."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from foredrive.errors import InputError
from foredrive.geometry.projection import pixels_to_rays
from foredrive.methods.neurad.config import FieldConfig
from foredrive.methods.neurad.decoders import UPSAMPLING, BeamDecoder, PatchDecoder, PatchDecoderConfig
from foredrive.methods.neurad.rays import FieldRays, beam_rays, pixel_rays
from foredrive.methods.neurad.render import FieldActors, NeuralField, SeenAlongRays
from foredrive.methods.reconstruction.gaussians import Gaussians
from foredrive.methods.reconstruction.reconstructed import ReconstructedScene, saved_tracks
from foredrive.methods.reconstruction.rendered import RenderedImage, RenderedSweep
from foredrive.methods.reconstruction.scene_graph import Content, SceneGraph
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.methods.reconstruction.views import CameraView, SweepView
from foredrive.methods.splatad.content import GaussianContent
from foredrive.scene.record import Record


@dataclass(frozen=True)
class FieldContent(Record):
    """The static part and A actors of a field: a `Content`. Edits change places in grids alone."""

    slot: Int[Tensor, "A"]
    """Place of each actor in the grid of actors. A copy has the place of its original."""
    shown: GaussianContent
    """Coloured lidar points of the static part and of the actors, for viewers."""
    table: Tensor
    """Table of the grid of actors, which identifies the field."""

    @property
    def device(self) -> torch.device:
        """The device of the field."""
        return self.slot.device

    def preview(self, row: int) -> Gaussians:
        """Return the lidar points of an actor in its frame, or of the static part for `STATIC`."""
        return self.shown.preview(row)

    def evidence(self, row: int) -> int:
        """Return the number of lidar points that are kept of an actor."""
        return self.shown.evidence(row)

    def without(self, row: int) -> "FieldContent":
        """Return the content without an actor."""
        others = torch.arange(len(self.slot), device=self.device) != row
        return FieldContent(self.slot[others], self.shown.without(row), self.table)

    def with_copy(self, source: Content, source_row: int, row: int) -> "FieldContent":
        """Return the content with one more actor in `row`, which looks like one of `source`.

        Raises:
            InputError: `source` is no field, or another one: features mean something to their own decoder
                alone.
        """
        if not isinstance(source, FieldContent):
            raise InputError("an actor that is not part of a field does not fit into a field")
        # A field that is opened twice from one file has equal tables
        if source.table.shape != self.table.shape or not torch.equal(source.table.to(self.table), self.table):
            raise InputError(
                "an actor of another neural field does not fit into this one, whose decoders cannot read its "
                "features; actors of Gaussian scenes can be inserted into each other"
            )
        return FieldContent(
            slot=torch.cat([self.slot, source.slot[source_row : source_row + 1].to(self.slot)]),
            shown=self.shown.with_copy(source.shown, source_row, row),
            table=self.table,
        )


def field_of(graph: SceneGraph) -> FieldContent:
    """Return the content of a scene that is a field.

    Raises:
        InputError: the scene is of another representation.
    """
    if not isinstance(graph.content, FieldContent):
        raise InputError("this scene is not a neural field")
    return graph.content


RAYS_AT_ONCE = 4096
"""Rays of an image or a sweep that are rendered together. More take memory and are not faster."""
_LEAST_ALPHA, _TINY = 1e-6, 1e-12
"""Opacity below which nothing stops a beam, and the least divisor of expected distances."""


@dataclass(frozen=True)
class FieldSceneConfig:
    """Parts of a `FieldScene`."""

    network: FieldConfig = field(default_factory=FieldConfig)
    decoder: PatchDecoderConfig = field(default_factory=PatchDecoderConfig)
    whole_ranges: bool = True
    """Ranges are the mean distances of what stops a ray. If False, they are not divided by the probability
    that something stops it, as in the reference implementation."""
    rolling: bool = True
    """Rows of an image and beams of a sweep have their own times. If False, all are simultaneous."""


class FieldScene(ReconstructedScene):
    """A field, its decoders, learned tracks and sensor corrections.

    Args:
        tracks: actors; row k is at place k of the grid of actors.
        shown: coloured points of the static part and of the actors, for viewers.
        cameras: number of cameras in the rig.
        config: parts of the scene.
        reach_m: range beyond which nothing stops a beam, m.
        middle_m: middle of the part of the scene that is not contracted.
        scale_m: half side of that part; None: that of `config`.
    """

    preview_name = "coloured lidar points"
    shown_mean_m: Tensor
    shown_log_scale: Tensor
    shown_rgb: Tensor
    shown_actor: Tensor

    def __init__(
        self,
        tracks: ActorTracks,
        shown: GaussianContent,
        cameras: int,
        config: FieldSceneConfig,
        reach_m: float,
        middle_m: Float[Tensor, "3"],
        scale_m: float | None = None,
    ) -> None:
        super().__init__(tracks, cameras, reach_m, frames=0)
        self.config = config
        sizes = config.network
        self.field = NeuralField(sizes, len(tracks), middle_m, scale_m)
        self.camera_decoder = PatchDecoder(sizes.width, cameras, sizes.appearance, config.decoder)
        self.camera_decoder.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.lidar_decoder = BeamDecoder(sizes.width, sizes.appearance)
        points = shown.gaussians
        self.register_buffer("shown_mean_m", points.mean_m)
        self.register_buffer("shown_log_scale", points.log_scale)
        self.register_buffer("shown_rgb", points.feature[:, :3].contiguous())
        self.register_buffer("shown_actor", shown.actor)
        self.eval()

    @property
    def content(self) -> FieldContent:
        """The actors' places in the grid, with points for viewers."""
        count = len(self.shown_rgb)
        points = Gaussians(
            mean_m=self.shown_mean_m,
            quaternion=self.shown_mean_m.new_tensor([1.0, 0, 0, 0]).expand(count, 4),
            log_scale=self.shown_log_scale,
            opacity_logit=self.shown_mean_m.new_full((count,), 4.0),
            feature=self.shown_rgb,
        )
        # Row k of the tracks is at place k of the grid of actors
        slot = torch.arange(len(self.track_id), device=self.device)
        shown = GaussianContent(points, self.shown_actor)
        return FieldContent(slot, shown, self.field.grids.actors.table)

    @property
    def sizes(self) -> dict[str, int]:
        """The number of numbers in the tables of all grids."""
        return {"grid entries": sum(table.numel() for table in tables_of(self.field))}

    def look(
        self,
        graph: SceneGraph,
        rays: FieldRays,
        mirror: Bool[Tensor, "A"] | None = None,
        generator: torch.Generator | None = None,
        learn_proposals: bool = True,
    ) -> SeenAlongRays:
        """Render features along rays.

        Args:
            graph: this scene, or an edited version of it.
            rays: in the scene's frame.
            mirror: actors whose left and right sides are swapped; None: none.
            generator: for the random places of samples in training.
            learn_proposals: whether the proposals' weights get gradients.
        """
        actors = FieldActors(graph.tracks, field_of(graph).slot, mirror)
        seen: SeenAlongRays = self.field(rays, actors, generator, learn_proposals)
        return seen

    def rays_of_pixels(
        self, view: CameraView, corner_uv: Int[Tensor, "2"], size: Int[Tensor, "2"]
    ) -> FieldRays:
        """Return the rays of a patch of an image, one for 3 × 3 pixels, row by row.

        Args:
            view: the camera as logged; it is corrected as learned.
            corner_uv: upper left pixel.
            size: numbers of rays along u and v.
        """
        uv = _pixels_of_rays(corner_uv, size).to(view.K)
        return pixel_rays(view, self.corrected_camera(view), uv, float(UPSAMPLING), self.config.rolling)

    def camera(self, graph: SceneGraph, view: CameraView) -> RenderedImage:
        """Render an image. One ray stands for 3 × 3 pixels; the last ones may reach beyond the image."""
        # Rays of the last column and row may reach beyond the image, hence rounded up
        high, wide = (-(-side // UPSAMPLING) for side in view.size_hw)
        corner_uv, size = torch.zeros(2, dtype=torch.int64), torch.tensor([wide, high])
        rays = self.rays_of_pixels(view, corner_uv, size)
        seen = self._in_parts(graph, rays)
        feature = seen["feature"].view(1, high, wide, -1)
        # Features of all rays form one image for the CNN
        rgb = self.camera_decoder(feature, torch.tensor([view.sensor], device=feature.device))[0]
        # Cut what reaches beyond the image
        rgb = rgb[:, : view.size_hw[0], : view.size_hw[1]]
        # The camera's axis is that of the row's own time: it turns during the read-out.
        along = pixels_to_rays(_pixels_of_rays(corner_uv, size).to(view.K), view.K, view.dist)[:, 2]
        alpha = seen["alpha"].view(high, wide)
        range_m = self._ranges(seen).view(high, wide) * along.view(high, wide)
        return RenderedImage(rgb, _enlarged(range_m, view.size_hw), _enlarged(alpha, view.size_hw))

    def prepare_sweep(self, view: SweepView) -> FieldRays:
        """Return the beams of a sweep as rays in the scene's frame."""
        return beam_rays(view, self.config.rolling)

    def sweep(self, graph: SceneGraph, points: FieldRays, t_s: float) -> RenderedSweep:
        """Render a sweep. The beams' own times count, not `t_s`.

        Beams that end beyond the reach do not return, nor those that nothing stops.
        """
        rays = FieldRays(*(tensor.to(self.device) for tensor in points))
        seen = self._in_parts(graph, rays)
        intensity, drop_logit = self.lidar_decoder(seen["feature"])
        range_m = self._ranges(seen)
        median_m = seen["median_m"]
        # A beam that ends beyond the reach, or nowhere, is lost: a
        # positive logit, whatever the decoder says
        beyond = torch.where(median_m.isfinite(), median_m, range_m) > self.reach_m
        nothing = seen["alpha"] < _LEAST_ALPHA
        drop_logit = torch.where(beyond | nothing, drop_logit.abs() + 1, drop_logit)
        return RenderedSweep(range_m, median_m, intensity, drop_logit, seen["alpha"], None)

    def _ranges(self, seen: Mapping[str, Tensor]) -> Float[Tensor, "R"]:
        """Return the ranges of rays from their expected distances."""
        depth_m, alpha = seen["depth_m"], seen["alpha"]
        return depth_m / alpha.clamp_min(_TINY) if self.config.whole_ranges else depth_m

    def _in_parts(self, graph: SceneGraph, rays: FieldRays) -> dict[str, Tensor]:
        """Return the features, distances and opacities of any number of rays."""
        rendered: dict[str, list[Tensor]] = {"feature": [], "depth_m": [], "alpha": [], "median_m": []}
        # Rays in parts bound the memory
        for first in range(0, max(len(rays.t_s), 1), RAYS_AT_ONCE):
            seen = self.look(graph, FieldRays(*(tensor[first : first + RAYS_AT_ONCE] for tensor in rays)))
            for name, values in rendered.items():
                values.append(getattr(seen, name))
        return {name: torch.cat(values) for name, values in rendered.items()}


def _pixels_of_rays(corner_uv: Int[Tensor, "2"], size: Int[Tensor, "2"]) -> Float[Tensor, "R 2"]:
    """Return the middles of the squares of pixels that the rays of a patch stand for, row by row."""
    width, height = size.tolist()
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    # Middle of the 3 x 3 pixels of each ray
    return corner_uv + UPSAMPLING * (torch.stack([u, v], dim=-1).flatten(0, 1) + 0.5)


def _enlarged(rays: Float[Tensor, "h w"], size_hw: tuple[int, int]) -> Float[Tensor, "H W"]:
    """Repeat the values of rays for their pixels."""
    pixels = rays.repeat_interleave(UPSAMPLING, 0).repeat_interleave(UPSAMPLING, 1)
    return pixels[: size_hw[0], : size_hw[1]]


def saved_field(weights: Path, config: FieldSceneConfig, reach_m: float) -> FieldScene:
    """Return a scene of the sizes of saved weights, which are to be loaded into it.

    Raises:
        InputError: the file cannot be read or holds no weights of a field.
    """
    try:
        saved: dict[str, Any] = load_file(weights)
        count = len(saved["shown_rgb"])
        points = Gaussians(
            saved["shown_mean_m"],
            torch.zeros(count, 4),
            saved["shown_log_scale"],
            torch.zeros(count),
            saved["shown_rgb"],
        )
        shown, cameras = GaussianContent(points, saved["shown_actor"]), len(saved["camera_late_s"])
        middle_m, scale_m = saved["field.middle_m"], None
        if config.network.scale_m is None:
            scale_m = float(saved["field.scale_m"])
        return FieldScene(saved_tracks(saved), shown, cameras, config, reach_m, middle_m, scale_m)
    except (OSError, SafetensorError, KeyError) as error:
        raise InputError(f"{weights}: not the weights of a field: {error}") from error


def tables_of(module: nn.Module) -> list[nn.Parameter]:
    """Return the tables of all grids of a module."""
    return [parameter for name, parameter in module.named_parameters() if name.endswith("table")]
