"""How jast is built, a folder for each subject. Public names are those of `jast` and its doors."""
