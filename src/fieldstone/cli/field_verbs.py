"""The verbs of `fieldstone` that make and show fields: train, render, mesh, splat; see `cli`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from fieldstone.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from fieldstone.field.base.training import CurvePoint

# Heavy imports live in the verbs, so that help and usage errors come at once.

Source = Annotated[Path, tyro.conf.Positional]
Out = Annotated[Path, tyro.conf.arg(aliases=["-o"])]

QUALITIES = {"draft": "20s", "normal": "60s", "high": "5m"}


def train(
    source: Source,
    /,
    out: Out,
    *,
    field: Literal["fast", "tiny", "nerf"] = "fast",
    budget: str | None = None,
    quality: Literal["draft", "normal", "high"] = "normal",
    memory: float = 4.0,
    steps: int | None = None,
    plan: Path | None = None,
    alpha: bool = True,
    photos: Path | None = None,
    masks: Path | None = None,
    size: int | None = None,
    refine_poses: bool = False,
    hold_out: str | None = None,
    device: str = "cpu",
    threads: int = 0,
    seed: int = 0,
) -> int:
    """A radiance field from posed photos, and its held-out views measured. Run it again to go on after a stop.

    Args:
        source: Folder that `reconstruct` wrote, COLMAP model with its images, Blender or LLFF folder, or
            transforms.json of nerfstudio or instant-ngp.
        out: Folder for the result: checkpoint.safetensors, metrics.json, curve.json, renders/test.
        field: fast needs seconds to minutes and no torch; tiny is the small network of the course at 100x100, nerf the
            original NeRF at 400x400.
        budget: Time for reading and training: 60s, 10m, 2h. A run that goes on after a stop follows the plan that it
            began with; for the classical networks, the time is that of all runs in this folder.
        quality: The budget, where none is given: draft 20s, normal 60s, high 5m.
        memory: GiB that grids and rays may take (fast only).
        steps: Stop after so many steps in all, if the budget lasts.
        plan: The plan.json that an earlier run of the fast field left: the same plan gives the same bytes.
        alpha: Use the transparency of photos; --no-alpha takes them as they look on the background (fast only).
        photos: Folder with the photos of a reconstruction, if they are not where they were.
        masks: Folder with a mask for each photo, named a.jpg.png, a.jpg or a.png for a.jpg. Nothing is learned where
            they are black, nor measured; by default those of the reconstruction (fast only).
        size: Photos are reduced to this length of their longer side, in pixels; by default to what --memory holds
            (fast only).
        refine_poses: Move the training photos a little, so that the field fits them; known points of a reconstruction
            hold them (fast only).
        hold_out: Photos to measure with, by name, with commas between: a.jpg,b.jpg; none learns from all of them. By
            default the test views of the source, or every 8th photo.
        device: cpu, cuda, mps; others than cpu need torch. The fast field was never tried on a GPU, and learns there
            the same field to rounding, not to the same bytes; it is rendered on the CPU.
        threads: 0 takes all cores. The result is the same for any number.
        seed: Every random number of the run follows from it.
    """
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    from fieldstone.run.fast_fields import train_fast_run
    from fieldstone.run.fields import train_run

    if field != "fast" and (plan is not None or not alpha):
        raise InputError(f"--plan and --no-alpha belong to the fast field; leave them out for --field {field}")
    if field != "fast" and (masks is not None or size is not None):
        raise InputError(f"--masks and --size belong to the fast field; leave them out for --field {field}")
    if field != "fast" and refine_poses:
        raise InputError(f"--refine-poses belongs to the fast field; leave it out for --field {field}")
    if size is not None and size < 1:
        raise InputError(f"--size {size}: the longer side of a photo has at least one pixel")
    budget_s = seconds(budget or QUALITIES[quality])
    console = plain_console()
    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn(), TextColumn("{task.fields[found]}"))
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("reading", total=budget_s, found="")

        def show(point: CurvePoint) -> None:
            found = f"step {point.step}, training PSNR {point.psnr:.2f} dB"
            progress.update(task, completed=point.seconds, found=found)

        shared: dict[str, Any] = {
            "budget_s": budget_s,
            "max_steps": steps,
            "seed": seed,
            "device": device,
            "threads": threads or None,
            "photos": photos,
            "hold_out": None if hold_out is None else photo_names(hold_out),
            "on_step": show,
            "on_stage": lambda stage: progress.update(task, description=stage),
        }
        if field == "fast":
            metrics = train_fast_run(
                source,
                out,
                plan=plan,
                use_alpha=alpha,
                memory_gib=memory,
                masks=masks,
                size_px=size,
                refine_poses=refine_poses,
                **shared,
            )
        else:
            metrics = train_run(source, out, field=field, **shared)
    done = f"{metrics['steps']} steps in {metrics['seconds']:.0f} s"
    if metrics["psnr"] is None:
        console.print(f"{done}; no photo was held out, so nothing is measured -> {out}", markup=False)
    else:
        console.print(
            f"{done}; {len(metrics['views'])} held-out views: PSNR {metrics['psnr']:.2f} dB, "
            f"SSIM {metrics['ssim']:.3f} -> {out}",
            markup=False,
        )
    return 0


def render(
    source: Source,
    /,
    *,
    path: str = "orbit",
    format: Literal["mp4", "gif", "png"] = "mp4",
    show: Literal["color", "depth", "normals", "opacity", "confidence"] = "color",
    frames: int | None = None,
    fps: int = 30,
    size: int | None = None,
    device: str = "cpu",
    threads: int = 0,
) -> int:
    """A film of a trained field.

    Args:
        source: Folder that `train` wrote; the film goes to its folder renders.
        path: orbit goes around what the photos look at, spiral loops near their middle, through goes from one to
            the next; dataset takes the poses of the training photos, FILE.json those of a file: frames as in
            transforms.json, or a camera_path of nerfstudio in the world of the photos.
        format: mp4 and gif give one file, png a folder of images.
        show: color; depth, near is bright; normals as colours, x to the right, y up, z to the camera; opacity;
            confidence, how many photos determine what is seen.
        frames: Number of images; by default 120, or one for each pose of dataset and files.
        fps: Images per second.
        size: Longer side in pixels; by default as trained.
        device: cpu, cuda, mps, for the classical networks; the fast field is rendered on the CPU.
        threads: 0 takes all cores.
    """
    from rich.progress import Progress

    from fieldstone.run.render import render_run

    console = plain_console()
    with Progress(console=console) as progress:
        task = progress.add_task("rendering", total=None)
        target = render_run(
            source,
            path=path,
            fmt=format,
            show=show,
            frames=frames,
            fps=fps,
            size_px=size,
            device=device,
            threads=threads or None,
            on_frame=lambda done, total: progress.update(task, completed=done, total=total),
        )
    console.print(f"rendered -> {target}", markup=False)
    return 0


def mesh(
    source: Source,
    /,
    *,
    format: Literal["ply", "obj", "glb"] = "ply",
    cells: int | None = None,
    level: float = 0.5,
    threads: int = 0,
) -> int:
    """A coloured mesh of a trained fast field, without what floats about, and how well it agrees with the field.

    Args:
        source: Folder that `train` wrote; mesh.FORMAT and mesh.json go there.
        format: ply, obj, or glb (y up).
        cells: Grid cells along the longest side; by default as the field, at most 320.
        level: Share of the light that matter must stop to count as solid.
        threads: 0 takes all cores.
    """
    from fieldstone.run.mesh import mesh_run

    console = plain_console()
    with console.status("reading") as status:
        record = mesh_run(source, fmt=format, cells=cells, level=level, threads=threads or None, on_stage=status.update)
    depth = record["depth_error_median_percent"]
    console.print(
        f"{record['vertices']} vertices, {record['faces']} faces, {record['floaters_removed']} floaters removed; "
        f"silhouettes agree with the field by {100 * record['silhouette_iou']:.1f} % (IoU), depths "
        f"{'nowhere comparable' if depth is None else f'to {depth:.2f} % (median)'} -> {source / record['path']}",
        markup=False,
    )
    return 0


def splat(source: Source, /, *, cells: int | None = None, level: float = 0.5, threads: int = 0) -> int:
    """Gaussian splats (PLY) of a trained fast field, for viewers of 3D Gaussian splatting, and how alike they look.

    Args:
        source: Folder that `train` wrote; splats.ply and splats.json go there.
        cells: Grid cells along the longest side; by default as the field, at most 320.
        level: Share of the light that matter must stop to count as solid.
        threads: 0 takes all cores.
    """
    from fieldstone.run.splats import splat_run

    console = plain_console()
    with console.status("reading") as status:
        record = splat_run(source, cells=cells, level=level, threads=threads or None, on_stage=status.update)
    found = record["psnr_to_field"]
    console.print(
        f"{record['splats']} splats; against the field: "
        f"{'not comparable' if found is None else f'PSNR {found:.2f} dB'} -> {source / record['path']}",
        markup=False,
    )
    return 0


def photo_names(text: str) -> tuple[str, ...]:
    """The names in a list with commas; none of them for the word none."""
    return () if text == "none" else tuple(name.strip() for name in text.split(",") if name.strip())


def seconds(text: str) -> float:
    """A time such as 300s, 10m, 1.5h, or a plain number of seconds."""
    units = {"s": 1.0, "m": 60.0, "h": 3600.0}
    number, unit = (text[:-1], units[text[-1]]) if text[-1:] in units else (text, 1.0)
    try:
        found = float(number) * unit
    except ValueError:
        found = -1.0
    if not 0 < found < float("inf"):
        raise InputError(f"--budget {text}: give a positive time such as 300s, 10m or 2h")
    return found


def plain_console() -> Console:
    """The terminal, without colours that rich would guess."""
    from rich.console import Console

    return Console(highlight=False)
