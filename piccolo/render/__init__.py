"""The cloud as a camera sees it: depths, surfaces, pictures."""
