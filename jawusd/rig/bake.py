"""Write the complete folder of a rig from a model and the actor's meshes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from pxr import Sdf

from jawusd.base.errors import RigError
from jawusd.evaluator import JawRig
from jawusd.formats.mesh import Mesh
from jawusd.rig.animation import write_animation
from jawusd.rig.asset_paths import record_checksums
from jawusd.rig.author import decoder_layer, interface_layer, proxy_layer, record_sidecars
from jawusd.rig.geo import MESH_PATHS, build_geometry, check_meshes
from jawusd.rig.layers import rename_actor, write_layer
from jawusd.rig.layout import (
    ACTOR,
    ACTOR_FILE,
    CAPTURED_FILE,
    ENCODE_FILE,
    GEO_FILE,
    ONNX_FILE,
    PACKAGE_FILE,
    PROXY_FILE,
    RIG_FILE,
    SKEL_FILE,
    check_prim_name,
)
from jawusd.rig.onnx_sidecar import check_written, decode_model, encode_model, write_onnx
from jawusd.rig.placeholder import with_estimated_bones
from jawusd.rig.publish import write_package
from jawusd.rig.skel import write_skel
from jawusd.rig.table import DEFAULT_SIZE, build_table


def bake_rig(
    folder: str | os.PathLike[str],
    rig: JawRig,
    meshes: Mapping[str, Mesh],
    *,
    name: str,
    fps: float,
    frames: ArrayLike | None = None,
    d: ArrayLike | None = None,
    table_size: int = DEFAULT_SIZE,
    proxies: Mapping[str, Mesh] | None = None,
    prim_name: str = Sdf.Path(ACTOR).name,
) -> list[Path]:
    """Write a rig: interface, decoder, geometry, ONNX graphs, captured motion if there is one, skeleton, package.

    A missing mandible mesh, and a missing skull with it, are replaced by estimated bones, which are marked as
    placeholders. Every file is written atomically, `actor.usda` after the files it refers to.

    Args:
        folder: Output folder; created if missing.
        meshes: `upper_teeth` and optionally `skull` in the skull frame, `lower_teeth` and optionally `mandible` in the
            mandible frame [mm].
        fps: Frame rate of the captured motion [frames per second].
        frames: Increasing numbers of the captured frames (F,).
        d: Parameters of the captured frames (F, 3) [mm], NaN where lost.
        table_size: Knots per axis of the sampled decoder: 17, 33 or 65.
        proxies: Low-polygon proxies of some of the meshes, with the same names; each adds variants.
        prim_name: Name of the actor's prim, and prefix of the joint names.

    Returns:
        The files, in the order written.

    Raises:
        RigError: Invalid meshes, bounds, frames, frame rate or prim name.
        OutputError: A file cannot be written.
        ValueError: Frames without d, or d without frames.
    """
    folder = Path(folder)
    if (frames is None) != (d is None):
        raise ValueError("frames and d belong together: give both or neither")
    if not fps > 0:
        raise RigError(f"the frame rate is {fps}; it must be greater than 0.", path=folder)
    check_meshes(meshes)
    check_prim_name(prim_name)
    meshes, estimate = with_estimated_bones(rig, meshes)
    geometry = build_geometry(meshes, rig.T_rest, estimate)
    moving = np.concatenate([meshes[key].vertices for key in ("mandible", "lower_teeth")])
    table = build_table(rig, moving, table_size)
    written = [write_layer(rename_actor(geometry, prim_name), folder / GEO_FILE)]
    if proxies:
        thinned = proxy_layer(proxies, meshes, rig.T_rest, estimate)
        written.append(write_layer(rename_actor(thinned, prim_name), folder / PROXY_FILE))
    written += [
        write_layer(rename_actor(decoder_layer(rig, table), prim_name), folder / RIG_FILE),
        write_onnx(folder / ONNX_FILE, decode_model(rig)),
        write_onnx(folder / ENCODE_FILE, encode_model(rig)),
    ]
    for sidecar in (ONNX_FILE, ENCODE_FILE):
        check_written(folder / sidecar, rig)
    interface = interface_layer(rig, name, meshes, fps, proxies or ())
    record_sidecars(interface, folder)
    record_checksums(interface, folder, [path.name for path in written if path.suffix == ".usdc"])
    written.append(write_layer(rename_actor(interface, prim_name), folder / ACTOR_FILE))
    written.append(write_skel(folder / SKEL_FILE, rig, list(meshes), fps, frames, d, prim_name))
    shown = folder / ACTOR_FILE
    if frames is not None and d is not None:
        skinned = [MESH_PATHS[key] for key in meshes]
        shown = write_animation(folder / CAPTURED_FILE, folder / ACTOR_FILE, frames, d, fps, rig=rig, skinned=skinned)
        written.append(shown)
    written.append(write_package(folder / PACKAGE_FILE, shown))
    return written
