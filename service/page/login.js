// Logging in with a token, where the room asks for one.

import { get, order, useCsrf } from "./api.js";
import { byId, h, replace, setText } from "./dom.js";
import { TEXTS } from "./texts.js";

const { login: words } = TEXTS;

// {name, role, csrf}: who this browser is to the service
export async function whoAmI() {
  const session = await get("api/v1/session");
  useCsrf(session.csrf);
  return session;
}

export function askForToken(onDone) {
  const dialog = byId("login");
  if (dialog.open) return; // what is being typed stays
  const token = h("input", { id: "token", type: "password", autocomplete: "current-password", required: true });
  const refusal = h("p", { role: "alert", id: "login-refusal" });
  const form = h("form", {
    onsubmit: async (event) => {
      event.preventDefault();
      try {
        await order("POST", "api/v1/session", { token: token.value });
        dialog.close();
        onDone();
      } catch (error) {
        refusal.textContent = error.message;
        token.select();
      }
    },
  }, h("h2", { id: "h-login" }, words.heading), h("label", { htmlFor: "token" }, words.token), token,
  refusal, h("button", { class: "main" }, words.button));
  replace(dialog, form);
  setText(byId("prompt"), words.heading);
  dialog.addEventListener("cancel", (event) => event.preventDefault());
  dialog.showModal();
}

export async function leave() {
  await order("DELETE", "api/v1/session");
  location.reload();
}
