"""Which (K, B) are stable, passive or robust, in closed form."""
