"""Read and check the experiment file and the images that it names."""
