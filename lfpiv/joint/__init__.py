"""Joint estimate of an image pair: one volume and one displacement field that explain both frames."""
