"""The library that a program calls: a scan that is opened, and what is asked of it."""
