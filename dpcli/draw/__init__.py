"""Pictures of point clouds, views and scores: this room takes arrays and writes pictures or pages; it never reads a file of ours."""
