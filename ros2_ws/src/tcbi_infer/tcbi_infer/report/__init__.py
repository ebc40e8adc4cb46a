"""Reports that a newcomer understands without help: one HTML file, nothing to install, nothing to load."""

from tcbi_infer.report.comparison import add_comparison
from tcbi_infer.report.inference import add_inference
from tcbi_infer.report.page import Figure, Report, Section, Table, file_name
from tcbi_infer.report.sections import (
    add_diagnosis,
    add_difference,
    add_history,
    add_kept_ladder,
    add_ladder,
    add_version,
)

__all__ = [
    "Figure",
    "Report",
    "Section",
    "Table",
    "add_comparison",
    "add_diagnosis",
    "add_difference",
    "add_history",
    "add_inference",
    "add_kept_ladder",
    "add_ladder",
    "add_version",
    "file_name",
]
