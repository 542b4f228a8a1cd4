"""Where in a coloured point cloud a 360-degree panorama was taken (PICCOLO, Kim et al., ICCV 2021)."""

__version__ = "0.1.0"
