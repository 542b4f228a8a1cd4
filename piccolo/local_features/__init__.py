"""Local features of the scan and of a photo: keypoints, matches, and the poses that matches vote for."""
