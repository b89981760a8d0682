"""What a stage or a run looks like: pictures, movies, pages and plots."""
