"""A page of results: plans of the storeys, photos as spheres, and the scan from the poses found."""
