"""Preset `paper`: Algorithm 1 of Kim et al., ICCV 2021, on the shared kernels."""
