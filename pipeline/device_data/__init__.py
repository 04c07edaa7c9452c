"""Device files, published values of devices, and models of the human arm."""
