"""Photos, their EXIF and masks, films."""
