"""The variant set `detail` of an actor: its scans as they are, proxies of few faces for crowds, or both by purpose.

The scans stay in the payload that every actor has, so that whatever knows nothing of variants shows them. A selected
proxy lies over them by a payload of the variant, which is stronger than the actor's own. Where both are selected, the
proxies lie beside the scans: viewports may draw them while renderers draw the scans.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from pxr import Sdf, UsdGeom

from jawusd.base.arrays import Array
from jawusd.formats.mesh import Mesh
from jawusd.rig.geo import MESH_PATHS, build_geometry
from jawusd.rig.layers import stage_of
from jawusd.rig.layout import ACTOR, BESIDE, BOTH, DETAIL, MANDIBLE, PROXY, PROXY_FILE, SCAN
from jawusd.rig.scan_look import hide_look

_BESIDE = ACTOR + BESIDE


def proxy_layer(
    proxies: Mapping[str, Mesh], meshes: Mapping[str, Mesh], T_rest: Array, placeholder: str | None
) -> Sdf.Layer:
    """Build `proxy.usdc`: `geo.usdc` with the meshes that have a proxy replaced, and a class that adds the proxies.

    Args:
        proxies: by some of the names of the meshes, in the same frames [mm].
        meshes, T_rest, placeholder: as for `build_geometry`.

    Raises:
        RigError: A mesh without faces or with values that are not finite.
    """
    layer = build_geometry({**meshes, **proxies}, T_rest, placeholder)
    _define_beside(layer, proxies)
    stage = stage_of(layer)
    for name, proxy in proxies.items():
        hide_look(UsdGeom.Mesh(stage.GetPrimAtPath(MESH_PATHS[name])), proxy, meshes[name])
    return _with_ordered_fields(layer)


def _with_ordered_fields(layer: Sdf.Layer) -> Sdf.Layer:
    """Return a layer read from the text of another.

    CopySpec adds fields in the order of their addresses in memory: a binary layer would differ from run to run.
    """
    ordered = Sdf.Layer.CreateAnonymous(".usda")
    ordered.ImportFromString(layer.ExportToString())
    return ordered


def _define_beside(layer: Sdf.Layer, proxies: Iterable[str]) -> None:
    """Define the class with the proxies under names of their own; a binary layer stores equal arrays once."""
    Sdf.CopySpec(layer, ACTOR, layer, _BESIDE)  # with the materials that its meshes are bound to
    layer.GetPrimAtPath(_BESIDE).specifier = Sdf.SpecifierClass
    mandible = layer.GetPrimAtPath(MANDIBLE.replace(ACTOR, _BESIDE))
    for attribute in list(mandible.properties):
        mandible.RemoveProperty(attribute)
    for name, path in MESH_PATHS.items():
        mesh = layer.GetPrimAtPath(path.replace(ACTOR, _BESIDE))
        if mesh is not None and name not in proxies:
            del mesh.nameParent.nameChildren[mesh.name]
        elif mesh is not None:
            _rename(mesh, Sdf.Path(_proxy_path(name)).name)
            _set_purpose(mesh, UsdGeom.Tokens.proxy)


def _rename(mesh: Sdf.PrimSpec, name: str) -> None:
    for subset in list(mesh.nameChildren):
        subset.name = subset.name.replace(mesh.name, name)
    mesh.name = name


def offer_detail(actor: Sdf.PrimSpec, proxies: Iterable[str]) -> None:
    """Give an actor the variants `scan`, which is selected and empty, `proxy`, and `both`.

    Args:
        proxies: Names of the meshes that have one.
    """
    variants = Sdf.VariantSetSpec(actor, DETAIL)
    Sdf.VariantSpec(variants, SCAN)
    for name, payload in ((PROXY, Sdf.Payload(f"./{PROXY_FILE}")), (BOTH, Sdf.Payload(f"./{PROXY_FILE}", _BESIDE))):
        Sdf.VariantSpec(variants, name).primSpec.payloadList.prependedItems = [payload]
    actor.variantSetNameList.prependedItems = [DETAIL]
    actor.variantSelections[DETAIL] = SCAN
    both = actor.path.AppendVariantSelection(DETAIL, BOTH)
    for name in proxies:
        scan = Sdf.CreatePrimInLayer(actor.layer, Sdf.Path(MESH_PATHS[name]).ReplacePrefix(actor.path, both))
        _set_purpose(scan, UsdGeom.Tokens.render)
        relationship = Sdf.RelationshipSpec(scan, "proxyPrim", custom=False)
        relationship.targetPathList.explicitItems = [Sdf.Path(_proxy_path(name))]


def _proxy_path(name: str) -> str:
    """Return where the proxy of a mesh lies beside it."""
    return f"{MESH_PATHS[name].removesuffix('Mesh')}Proxy"


def _set_purpose(prim: Sdf.PrimSpec, purpose: str) -> None:
    attribute = Sdf.AttributeSpec(prim, "purpose", Sdf.ValueTypeNames.Token, Sdf.VariabilityUniform)
    attribute.default = purpose
