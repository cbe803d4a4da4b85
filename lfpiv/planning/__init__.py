"""What a campaign will take, scaled from its first pair: time, memory and disk."""
