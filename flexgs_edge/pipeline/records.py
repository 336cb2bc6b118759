"""Small records of what went into a job, for its result."""

from __future__ import annotations

import os

from flexgs_edge.adapt import Step, Target
from flexgs_edge.pipeline.inputs import Scene, Views
from flexgs_edge.report.result import SceneInfo, ViewsInfo


def scene_info(scene: Scene) -> SceneInfo:
    """The record of a scene."""
    return SceneInfo(
        path=os.fspath(scene.path),
        count=scene.source.count,
        sh_degree=scene.source.sh_degree,
        ply_bytes=scene.ply_bytes,
        ply_bytes_without_normals=scene.ply_bytes_without_normals,
        notes=tuple(scene.source.notes),
    )


def views_info(views: Views) -> ViewsInfo:
    """The record of the views; width and height are the largest."""
    return ViewsInfo(
        cameras=views.cameras_from,
        images=None if views.images_path is None else os.fspath(views.images_path),
        total=len(views.cameras),
        train=len(views.train),
        held_out=len(views.held_out),
        width=max(camera.width for camera in views.cameras),
        height=max(camera.height for camera in views.cameras),
        notes=views.notes,
    )


def step_words(step: Step, target: Target | None) -> str:
    """A step of a search in a line."""
    figure = target.report(step.size, step.measurement) if target else ""
    figure += " (estimated)" if step.estimated else ""
    return f"{step.phase}: prune {step.choice.prune / 1000:g}, SH {step.choice.sh / 1000:g}: {figure}, {step.seconds:.1f} s"
