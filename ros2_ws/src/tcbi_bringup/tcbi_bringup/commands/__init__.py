"""One module per command of `./tcbi`: SUMMARY, add_arguments(parser), run(args) -> exit status."""
