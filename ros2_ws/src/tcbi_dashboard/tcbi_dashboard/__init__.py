"""The web page: the loop of the command line in a browser."""
