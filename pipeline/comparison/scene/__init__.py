"""What a comparison needs: its parts, its file, where it comes from."""
