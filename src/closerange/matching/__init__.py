"""The same feature in other views: search geometry, matches and their table."""
