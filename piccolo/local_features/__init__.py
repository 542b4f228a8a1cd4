"""Poses of a camera from single matches: rays of the photo and points of the scan."""
