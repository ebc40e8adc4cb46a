"""The whole loop on an emulated robot with a hidden effect, told line by line."""
