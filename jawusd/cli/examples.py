"""Example command lines shown in the help of each command."""

#: Example command lines by command; each has at most 76 characters.
EXAMPLES = {
    "doctor": ("jawusd doctor",),
    "demo": ("jawusd demo -o capture", "jawusd demo -o capture --seed 3 --frames 480"),
    "init": ("jawusd init footage --square-mm 8", "jawusd init --reference"),
    "check": ("jawusd check capture",),
    "calibrate": ("jawusd calibrate capture -o capture/calibration.toml",),
    "cameras": ("jawusd cameras metashape.xml -o cameras.usda --unit-mm 1000",),
    "sync": ("jawusd sync capture", "jawusd sync left.mp4 front.mp4 right.mp4 --plot sync.png"),
    "segment": ("jawusd segment capture -o masks", "jawusd segment capture -o masks --keys drawn --force"),
    "scans": ("jawusd scans capture",),
    "photos": ("jawusd photos front.png left.png --upper-teeth up.ply --lower-teeth low.ply",),
    "plates": ("jawusd plates capture out",),
    "build": ("jawusd build examples/capture -o out", "jawusd build capture -o out --dry-run"),
    "build-many": ("jawusd build-many list.txt -o actors --workers 4",),
    "track": ("jawusd track capture -o tracks.npz --overlay overlay.mp4",),
    "fit": (
        "jawusd fit tracks.npz --capture capture -o model.npz",
        "jawusd fit poses.csv --landmarks landmarks.json --length-unit m",
    ),
    "bake": ("jawusd bake model.npz --capture capture -o out",),
    "publish": ("jawusd publish out -o lib/hero --prefix hero", "jawusd publish shot.usda -o shot.usdz"),
    "library": ("jawusd library actors --add out --name hero", "jawusd library actors --plot figures"),
    "animate": (
        "jawusd animate out keys.json -o out/anim_take.usdc",
        "jawusd animate out --arkit face.csv -o take.glb",
    ),
    "retarget": (
        "jawusd retarget out/anim_take.usdc --from out --to other -o anim_other.usdc",
        "jawusd retarget --landmarks face.json --library people -o model.npz",
    ),
    "solve": (
        "jawusd solve out shot -o take.npz --overlay take.mp4 --report take.html",
        "jawusd solve out shot --skin skin.npz --face face.csv -o take.npz",
    ),
    "live": (
        "jawusd live out shot --source left=/dev/video0 --osc 127.0.0.1:9000 --view",
        "jawusd live out shot --source left=/dev/video0 --skin skin.npz --face face.csv",
    ),
    "rebake": ("jawusd rebake shot.usda -o jaws.usdc", "jawusd rebake out export.fbx -o anim_edited.usdc"),
    "arkit-fit": ("jawusd arkit-fit out face.csv take.npz -o arkit.npz",),
    "arkit-table": ("jawusd arkit-table out --mapping arkit.npz -o joint.csv",),
    "align": ("jawusd align out points.json -o T_skull_model.json",),
    "skin-fit": (
        "jawusd skin-fit out take.npz face.csv -o skin.npz --bite 1200-1260",
        "jawusd skin-fit out take.npz markers.c3d --rigid head=HL,HR,HF --rest-frame 0",
    ),
    "view": ("jawusd view capture --tracks out", "jawusd view out --page jaw.html"),
    "info": ("jawusd info out", "jawusd info out/tracks.npz --frame 120"),
    "report": ("jawusd report out", "jawusd report out --experiments"),
    "validate": ("jawusd validate out", "jawusd validate out --face jaw.npz --align T_skull_model.json"),
    "pose": ("jawusd pose out --d 20 2 1",),
    "encode": ("jawusd encode out poses.csv -o d.csv",),
    "ik": ("jawusd ik out --point 0,2,-3 --target 0,-18,-10",),
}
