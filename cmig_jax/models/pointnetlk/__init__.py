"""PointNetLK and PointNetLK Revisited: the network, its flags and its losses."""
