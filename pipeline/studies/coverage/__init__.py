"""How often statements about devices that are not ideal hold the truth: the kinds of such devices."""
