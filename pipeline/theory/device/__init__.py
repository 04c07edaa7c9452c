"""The general loop: boundary, costs and passivity of devices that are not ideal."""
