"""What each command does in a few words, as `jawusd --help` lists it on 80 columns, in that order."""

SUMMARIES = {
    "init": "Begin a capture: look at a folder, write its capture.toml.",
    "doctor": "Say what is installed and what works here.",
    "cameras": "Carry calibrated cameras between programs.",
    "build": "Turn a capture into a rig.",
    "track": "Track both rows of teeth through the masks.",
    "fit": "Fit a jaw model to tracked or given poses.",
    "bake": "Write the OpenUSD rig of a model.",
    "demo": "Render a synthetic capture with known truth.",
    "build-many": "Build many captures, one process each.",
    "check": "Check a capture in seconds, before any work.",
    "calibrate": "Calibrate the cameras from clips of a board.",
    "sync": "Find the frame offsets between cameras.",
    "segment": "Make masks of both rows of teeth from the videos.",
    "scans": "Tell crown and gum of the scans apart.",
    "photos": "Find how two scans bite, from photographs.",
    "info": "Say what a rig file or tracks hold.",
    "pose": "Print the jaw pose of parameters d.",
    "encode": "Find the d nearest to given poses.",
    "validate": "Check a rig, or judge poses.",
    "ik": "Find the d that bring a point to a target.",
    "animate": "Write an animation of a rig from keys, poses or ARKit.",
    "arkit-fit": "Learn a person's ARKit jaw weights.",
    "arkit-table": "Write what the jaw joint does per ARKit shape.",
    "rebake": "Bring d and mandible of a stage together again.",
    "publish": "Copy a rig under names of its own, or pack a shot.",
    "solve": "Solve a performance of the person of a rig.",
    "live": "Follow the jaw as cameras run.",
    "retarget": "Carry a motion to another person's rig.",
    "library": "Keep many actors and compare their ranges.",
    "plates": "Write the footage without lens distortion.",
    "report": "Write the report of a build or a solve again.",
    "view": "See a rig or a capture in the browser.",
}

EXIT_CODES = (
    "Exit codes: 0 done, 1 the answer is no (invalid poses, something missing, a failed build of many), 2 wrong usage, "
    "3 a file is not what it should be, 4 a package is missing, 5 the capture, 6 tracking, 7 fitting, 8 the rig, "
    "9 the model, 10 the output, 11 a cluster, 12 memory did not suffice or a library crashed, 130 stopped with Ctrl+C."
)
