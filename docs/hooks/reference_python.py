"""The pages of the Python API: one directive of mkdocstrings per package or module."""

STAGES = (
    "build", "track", "fit", "bake", "check", "calibrate", "segment", "scans", "solve", "live", "report",
    "library", "many", "start_capture", "cameras",
    "subject", "workspace", "skin",
)  # fmt: skip

PAGES = {
    "evaluator": (
        "Needs only numpy: `import jawusd.evaluator` loads no other package. `python -m jawusd.evaluator` "
        "does the same on the command line.",
        ["jawusd.evaluator", "jawusd.fast"],
    ),
    "solvers": ("The rig in PyTorch, for gradient-based solvers.", ["jawusd.solvers"]),
    "rig": (
        "Reading, checking and animating rigs in OpenUSD.",
        ["jawusd.rig", "jawusd.rig.rebake", "jawusd.rig.publish", "jawusd.rig.glb", "jawusd.rig.cameras"],
    ),
    "library": (
        "A folder of actors, and retargeting between persons.",
        ["jawusd.library.personal", "jawusd.library.timing"],
    ),
    "pipeline": (
        "The stages connected, as the commands call them. Heavy packages are loaded when they are needed.",
        [f"jawusd.pipeline.{name}" for name in STAGES],
    ),
    "fitting": (
        "Fitting the jaw model to poses, and tracking poses in pictures.",
        [
            "jawusd.fitting",
            "jawusd.fitting.align",
            "jawusd.fitting.face_judging",
            "jawusd.fitting.skin",
            "jawusd.tracking",
            "jawusd.photographs.align",
        ],
    ),
    "geometry": ("Rotations, rigid motions, cameras and the anatomical frame.", ["jawusd.geometry"]),
    "plugins": (
        "Files that `python -m jawusd.plugins` copies out of the package, to run inside other programs.",
        ["jawusd.plugins.jawusd_reader", "jawusd.plugins.jawusd_recipes", "jawusd.plugins.extension"],
    ),
}

TOP = """# jawusd

::: jawusd
    options:
      show_root_heading: false
      show_root_toc_entry: false
      members: [load]

| name | |
|---|---|
| [`jawusd.load`][jawusd.load] | read a rig |
| [`jawusd.JawRig`][jawusd.evaluator.JawRig] | the rig: pose, encode, margin, validate, ik |
| [`jawusd.build`][jawusd.pipeline.build.build] | from a capture to a rig in one call |
| [`jawusd.track`][jawusd.pipeline.track.track] | track both dental arches |
| [`jawusd.align`][jawusd.fitting.align.align] | align a face model with a rig |
| [`jawusd.fit_skin`][jawusd.fitting.skin.fit_skin] | learn the jaw from facial skin |
| [`jawusd.save_skin`][jawusd.fitting.skin.save_skin] | store what was learned |
| [`jawusd.load_skin`][jawusd.evaluator.skin.load_skin] | read what was learned |
| [`jawusd.JawusdError`][jawusd.base.errors.JawusdError] | the base class of all errors |
| `jawusd.__version__` | the version, as text |
"""


def pages():
    """Return the pages by their place."""
    found = {"reference/python/jawusd.md": TOP}
    for name, (sentence, modules) in PAGES.items():
        title = "jawusd.fitting and jawusd.tracking" if name == "fitting" else f"jawusd.{name}"
        directives = "\n".join(f"::: {module}\n" for module in modules)
        found[f"reference/python/{name}.md"] = f"# {title}\n\n{sentence}\n\n{directives}"
    return found
