"""The lock of an open file, which ends with its process."""

import sys

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl


def lock_descriptor(number: int) -> bool:
    """Lock an open file until it is closed; False if the lock is taken."""
    try:
        if sys.platform == "win32":
            msvcrt.locking(number, msvcrt.LK_NBLCK, 1)
        else:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    return True
