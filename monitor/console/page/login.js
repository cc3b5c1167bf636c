// Gives the token for a cookie.
const form = document.getElementById("form");
const said = document.getElementById("said");

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  said.textContent = "";
  const body = JSON.stringify({ token: document.getElementById("token").value });
  try {
    const answer = await fetch("/login", { method: "POST", headers: { "Content-Type": "application/json" }, body });
    if (answer.ok) location.replace("/");
    else said.textContent = "This is not the token.";
  } catch {
    said.textContent = "The console does not answer.";
  }
});
