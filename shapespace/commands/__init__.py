"""The commands that use a model without a server: ``decode``, ``encode``, ``fit``, ``page`` and ``models``.

To add a command, write a module with its arguments and its function, and list it here. This module imports none of the
packages that a model needs, so that ``--help`` always answers.
"""

from shapespace.command_line import Subcommand

#: Packages of the extra ``model`` by the names of their modules, without those that are only faster.
NEEDED = ("onnx", "onnxruntime", "pydantic", "trimesh")
_MODEL = "MODEL is a name that the command `models` lists, or the folder of a bundle."


def _subcommand(name: str, purpose: str, examples: list[str], details: str = "") -> Subcommand:
    return Subcommand(
        name,
        f"shapespace.commands.{name}:{name}",
        late_params=f"shapespace.commands.{name}:PARAMS",
        help=f"{purpose}\n\n{details}",
        short_help=purpose,
        examples=examples,
        needs=NEEDED,
        extra="model",
    )


COMMANDS = (
    _subcommand(
        "decode",
        "Write the shapes of codes as mesh files.",
        [
            "figure --random 5 --out shapes",
            "freaky-torus --latent 1,2,3,4 --out torus.obj",
            "figure --random 100 --seed 7 --distribution population --format ply --out shapes",
        ],
        f"{_MODEL} A file has the format of its extension. A folder gets one file for each shape, and codes.csv. "
        "Without --latent and --random, the reference shape is written.",
    ),
    _subcommand(
        "encode",
        "Find the codes of meshes in correspondence, as a CSV table.",
        ["figure pose.obj", "figure poses/*.ply --csv codes.csv"],
        f"{_MODEL} The meshes have the vertices of the model in the same order. Check the column status.",
    ),
    _subcommand(
        "fit",
        "Find the code and the position of a scan.",
        ["figure scan.ply --out fitted.glb", "figure half.ply --partial --scale free --json fit.json"],
        f"{_MODEL} SCAN is a mesh or a point cloud, in any position, without correspondence. The fitted shape lies on "
        "the scan. Check the status before you use it.",
    ),
    _subcommand(
        "page",
        "Write a web page of a model that needs no server, only a place for files.",
        ["figure --out site", "runs/hands/models/hands --out site --force"],
        f"{_MODEL} Any web server can show the files, also in a folder of a site. The browser computes the shapes.",
    ),
    _subcommand("models", "List the models that have a name, with version, size of a code and licence.", [""]),
)
