"""Raw plenoptic images: the microlens array, the light field behind it, and checks of the images."""
