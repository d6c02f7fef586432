"""Parts of ``marker_mapper``: camera poses, services, topics and refinement of the map."""
