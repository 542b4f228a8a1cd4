"""Threads, processes, other machines, and their memory."""
