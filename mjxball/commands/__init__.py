"""The command lines that join training, export and the judge. They stand above every other part of the package."""
