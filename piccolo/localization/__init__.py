"""The default method: where in a prepared scan a panorama was taken."""
