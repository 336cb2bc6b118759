"""A scene from arrays to a file's bytes and back: `python docs/example_arrays.py`.

The scene is a ball of 600 Gaussians. Nothing is read from a disk, and nothing is written.
"""

from __future__ import annotations

import math

import numpy as np

import flexgs_edge


def ball(count: int = 600) -> flexgs_edge.Scene:
    """Gaussians on a sphere of radius 1, coloured by their place."""
    steps = np.arange(count)
    height = 1 - (2 * steps + 1) / count
    angle = steps * math.pi * (3 - math.sqrt(5))
    radius = np.sqrt(1 - height**2)
    places = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    colours = places / 2 + 0.5
    return flexgs_edge.Scene.from_arrays(
        means=places,
        log_scales=np.full((count, 3), math.log(0.06)),
        quats=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        opacity_logits=np.full(count, 3.0),
        sh_dc=(colours - 0.5) / 0.28209479177387814,  # the SH of degree 0 is a constant
    )


def ring(views: int = 9, width: int = 64, height: int = 48) -> flexgs_edge.Cameras:
    """Cameras around the ball that look at its middle."""
    poses = np.tile(np.eye(4), (views, 1, 1))
    for pose, turn in zip(poses, np.linspace(0, 2 * math.pi, views, endpoint=False), strict=True):
        pose[:3, :3] = [[math.cos(turn), 0, -math.sin(turn)], [0, 1, 0], [math.sin(turn), 0, math.cos(turn)]]
        pose[2, 3] = 4.0  # the ball is 4 units ahead
    lens = np.array([[60.0, 0.0, width / 2], [0.0, 60.0, height / 2], [0.0, 0.0, 1.0]])
    return flexgs_edge.Cameras.from_matrices(poses, np.tile(lens, (views, 1, 1)), np.tile([width, height], (views, 1)))


def main(device: str | None = None) -> None:
    """Compress the ball, decode it, and compare what comes back."""
    scene, cameras = ball(), ring()
    data, result = flexgs_edge.encode(scene, cameras=cameras, max_drop=1.0, effort="fast", device=device)
    print(result.summary())

    decoded = flexgs_edge.decode(data)
    arrays = decoded.arrays()
    print("means", arrays["means"].shape, "colours", arrays["sh_dc"].shape)

    before = scene.render(cameras[0], device=device)
    after = decoded.render(cameras[0], device=device)
    error = float(np.mean((before - after) ** 2))
    print(f"{len(data)} bytes; PSNR of the first view against the original's: {-10 * math.log10(error):.1f} dB")


if __name__ == "__main__":
    main()
