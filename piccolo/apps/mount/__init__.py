"""The mount of a camera on a scanner, vehicle or robot, by photos and a trajectory."""
