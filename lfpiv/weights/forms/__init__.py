"""Forms in which the weights of a rig are stored, one per module; `lfpiv.weights.forms.table` lists them."""
