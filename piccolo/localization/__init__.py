"""The default method: it localizes a panorama in a prepared scan."""
