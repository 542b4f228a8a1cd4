"""Local features of the scan and of a photo: keypoints, matches, and poses proposed by matches."""
