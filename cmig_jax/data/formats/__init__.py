"""File formats of point clouds and meshes, one file per family; `data.geometry_files` chooses among them by the suffix."""
