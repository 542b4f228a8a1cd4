"""The commands, a module each: scripts of the same names in tools/."""
