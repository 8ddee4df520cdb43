"""The subcommands of stewart-drake, a module for each family. They import Drake when they run."""
