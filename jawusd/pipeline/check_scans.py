"""Checks of the meshes of a capture: readable, in mm, labelled, in occlusion, bones where their teeth are."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jawusd.base.errors import JawusdError
from jawusd.formats.finding import Finding
from jawusd.geometry import LANDMARKS
from jawusd.pipeline.check_parts import Parts, found_error
from jawusd.pipeline.meshes import BONES, MESHES
from jawusd.pipeline.scan_labels import TEETH, label_teeth
from jawusd.pipeline.subject import subject_of_capture

# Teeth lie on their bone: the nearest point of the bone to the middle of the crowns is closer than this [mm].
_TEETH_TO_BONE_MM = 20.0
_CONDYLES_MM = (75.0, 140.0)  # distance of the condyle centres: adults have about 100


def scans(parts: Parts) -> Iterator[Finding]:
    """Read every mesh, label the scans and prepare them."""
    from jawusd.meshes.meshio import load_mesh
    from jawusd.tracking.contour.scan import ARCH_NAMES, prepare_scan

    given = parts.given.scans
    files = {name: path for name in MESHES if (path := getattr(given, name)) is not None and parts.usable(path)}
    for name, path in files.items():
        try:
            parts.meshes[name] = load_mesh(path, kind="bone" if name in BONES else "scan")
        except JawusdError as error:
            yield found_error("mesh", error)
    labelled = label_teeth(parts.meshes, files, given.labels)
    for arch, scan in labelled.items():
        parts.meshes[TEETH[arch]] = scan.mesh
        yield from scan.findings
    prepared = []
    for arch in ARCH_NAMES:
        mesh = parts.meshes.get(f"{arch}_teeth")
        if mesh is None:
            continue
        try:
            prepared.append(prepare_scan(mesh, arch))
        except JawusdError as error:
            yield found_error("scan", error)
    parts.scans = tuple(prepared) if len(prepared) == len(ARCH_NAMES) else ()


def occlusion(parts: Parts) -> Iterator[Finding]:
    """Look whether the two scans are a bite."""
    from jawusd.tracking.initialization.scan_checks import occlusion_findings

    yield from occlusion_findings(parts.scans, parts.given.anatomy.T_anatomical_skull)[1]


def bone_findings(parts: Parts) -> Iterator[Finding]:
    """Look whether bones and landmarks lie where the teeth are."""
    for bone, arch in zip(BONES, ("lower", "upper"), strict=True):
        if bone not in parts.meshes:
            continue
        crowns = parts.scans[("upper", "lower").index(arch)].crown_vertices(300)
        vertices = parts.meshes[bone].vertices
        apart = float(np.median([np.linalg.norm(vertices - point, axis=1).min() for point in crowns]))
        if apart > _TEETH_TO_BONE_MM:
            yield Finding(
                "bone_elsewhere",
                "warning",
                f"the {bone} lies {apart:.0f} mm off the {arch} teeth, up to {_TEETH_TO_BONE_MM:g} mm are possible",
                apart,
                _TEETH_TO_BONE_MM,
                path=str(getattr(parts.given.scans, bone)),
                hint="Export it in the coordinate frame of the scans, in mm.",
            )
    landmarks = dict(zip(LANDMARKS, subject_of_capture(parts.given, parts.meshes).landmarks, strict=True))
    width = float(np.linalg.norm(landmarks["condyle_left"] - landmarks["condyle_right"]))
    if not _CONDYLES_MM[0] <= width <= _CONDYLES_MM[1]:
        yield Finding(
            "condyles",
            "warning",
            f"the condyles are {width:.0f} mm apart, persons have {_CONDYLES_MM[0]:g} to {_CONDYLES_MM[1]:g} mm",
            width,
            _CONDYLES_MM[width > _CONDYLES_MM[1]],
            path=parts.description,
            hint="Check the mandible mesh, or give the condyles in [anatomy.landmarks].",
        )
