"""Where pixels enter: frames, decoders with limits, folders of images."""
