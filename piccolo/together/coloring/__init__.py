"""Colours for scans from localized photos, and poses of photos in the colours that other photos give."""
