"""The stages of a run: one file for each, with its version, settings, results, warnings and work."""

#: Names of the stages in order, without what they import: the command's help needs no more.
STAGE_NAMES = (
    "ingest",
    "mean",
    "modes",
    "factors",
    "samples",
    "networks",
    "generalisation",
    "evaluation",
    "export",
)
