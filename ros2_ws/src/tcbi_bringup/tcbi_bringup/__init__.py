"""Launcher, emulated robot, the tcbi command and the demo."""
