"""The paper's five figures, drawn from our flights, each with a caption that says what agrees and what does not."""
