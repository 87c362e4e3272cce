"""The pages, a module each: which addresses they have, and what they show."""
