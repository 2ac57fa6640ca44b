"""Images to tracks: windowed reading, detection, matching, linking."""
