"""Hostile input for every command, made from small sound files by rules: the same on every run."""
