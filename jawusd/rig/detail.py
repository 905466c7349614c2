"""The variant set `detail` of an actor: its scans as they are, or proxies of few faces for crowds and slow machines.

The scans stay in the payload that every actor has, so that whatever knows nothing of variants shows them. A selected
proxy lies over them by a payload of the variant, which is stronger than the actor's own.
"""

from __future__ import annotations

from collections.abc import Mapping

from pxr import Sdf, UsdGeom

from jawusd.formats.mesh import Mesh
from jawusd.geometry.arrays import Array
from jawusd.rig.geo import MESH_PATHS, build_geometry
from jawusd.rig.layers import stage_of
from jawusd.rig.layout import DETAIL, PROXY, PROXY_FILE, SCAN
from jawusd.rig.scan_look import hide_look


def proxy_layer(
    proxies: Mapping[str, Mesh], meshes: Mapping[str, Mesh], T_rest: Array, placeholder: str | None
) -> Sdf.Layer:
    """Build `proxy.usdc`: `geo.usdc` with the meshes that have a proxy replaced.

    Args:
        proxies: by some of the names of the meshes, in the same frames [mm].
        meshes, T_rest, placeholder: as for `build_geometry`.

    Raises:
        RigError: A mesh without faces or with values that are not finite.
    """
    layer = build_geometry({**meshes, **proxies}, T_rest, placeholder)
    stage = stage_of(layer)
    for name, proxy in proxies.items():
        hide_look(UsdGeom.Mesh(stage.GetPrimAtPath(MESH_PATHS[name])), proxy, meshes[name])
    return layer


def offer_detail(actor: Sdf.PrimSpec) -> None:
    """Give an actor the variants `scan`, which is selected and empty, and `proxy`."""
    variants = Sdf.VariantSetSpec(actor, DETAIL)
    Sdf.VariantSpec(variants, SCAN)
    proxy = Sdf.VariantSpec(variants, PROXY)
    proxy.primSpec.payloadList.prependedItems = [Sdf.Payload(f"./{PROXY_FILE}")]
    actor.variantSetNameList.prependedItems = [DETAIL]
    actor.variantSelections[DETAIL] = SCAN
