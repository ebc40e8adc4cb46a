"""Names of the files in `runs/` that the page reads: light, so that the page need not import what writes them."""

COMPARISON = "compare-"  # folders, one for each comparison
SUMMARY = "summary.json"
DIAGNOSIS = "diagnosis-"  # files, as `tcbi_infer.diagnose.adopt` writes them
MOMENTS = "moments-"  # the worst moments of the diagnosis of the same name
MEASURED = "history-"  # file of a rig, as `tcbi_infer.compare.history` writes it
