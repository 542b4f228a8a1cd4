"""Colours for scans from localized photos, and poses of photos from the colours that others give."""
