"""Poses that a user gives, in files of other programs: their errors, times, and a bundle of them adjusted."""
