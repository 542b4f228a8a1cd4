"""The library that a program calls: it opens a scan and localizes photos in it."""
